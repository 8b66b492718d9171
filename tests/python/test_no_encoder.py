"""Surveys without an encoder: nothing but the pictures holds the scale along the pipe, and the pupil's shift, a length,
is to be taken in a unit that nobody told. What is given is within its interval."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import pipefish as pf
from pipefish.camera import Camera
from pipefish.errors import PipefishError
from pipefish.measure import measure
from pipefish.measured_files import document_of
from pipefish.measurement import Measurement
from pipefish.pupil import shift_sigma
from pipefish.scale import Known
from pipefish.survey import Survey
from pipefish.wall import measured_wall
from synthetic import write_survey
from test_reconstruct_cli import objects_of
from tube_tracks import Drive, fisheye, tube_drive

SHIFT = 0.001  # metres of e1: 2.5 mm at 90 degrees
SIZE = 0.3


def calibrated(camera: Camera, shift: float | None) -> Camera:
    """Its profile as a calibration has it that found this shift of the pupil, to a hundredth; None: that found none."""
    names, sigmas = ("c_u", "c_v", "pupil_e1"), np.array([0.1, 0.1, 1e-5])
    count = 2 if shift is None else 3
    return dataclasses.replace(
        camera, pupil_e1=shift or 0.0, covariance=np.diag(sigmas[:count] ** 2), covariance_parameters=names[:count]
    )


def driven(seed: int, length: float = 2.0, shift: float = SHIFT) -> Drive:
    return tube_drive(seed, length, density=600.0, ovality=0.0, camera=fisheye(95, pupil_e1=shift))


def measured(folder: Path, drive: Drive, profile: Camera, nominal: float = SIZE, **given: object) -> Measurement:
    path = folder / f"{len(list(folder.iterdir()))}.mcap"
    write_survey(path, objects=objects_of(drive, profile=profile, encoder=False, nominal=nominal))
    return measure(Survey.open(path), pictures=False, threads=2, **given)


def taper(rec: pf.Reconstruction, drive: Drive) -> float:
    """Change of the scale from one end to the other, by the steps from frame to frame."""
    steps = [np.linalg.norm(np.diff(c, axis=0), axis=1) for c in (rec.centres, drive.centres[rec.frames])]
    scale = np.log(steps[0] / steps[1])
    return float(np.polyfit(np.linspace(0, 1, len(scale)), scale, 1)[0])


def shift_spread(rec: pf.Reconstruction) -> float:
    """Sigma of the pupil's shift in the structure's unit: of tracks alone it is all that is in the border."""
    return float(np.sqrt(rec.parts[0][0].border[0, 0]))


def held(m: Measurement, true: float = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Errors of the stations' diameters and their sigmas, relative."""
    table = m.measured[0].tube.stations
    return table["d_mean"] / true - 1, np.hypot(table["d_mean_sigma"], table["d_mean_systematic"]) / true


def test_a_pupils_shift_bends_no_scale_where_the_pipes_size_tells_its_unit() -> None:
    """Left out, 2.5 mm at 90 degrees taper 2 m of DN300 by more than 5 %. In the structure's unit, which a diameter
    that is 5 % wrong tells well enough, next to nothing of it is left."""
    drive = driven(3)
    central = pf.reconstruct(drive.tracks, drive.camera)
    assert abs(taper(central, drive)) > 0.05 and central.pupil == [0.0]
    for size in (SIZE, 1.05 * SIZE):
        rec = pf.reconstruct(drive.tracks, drive.camera, pupil_sigma=5e-5, diameter=size)
        assert rec.status == "ok" and rec.unit == "arbitrary" and abs(taper(rec, drive)) < 0.02
        unit = np.linalg.norm(drive.centres[rec.frames[-1]] - drive.centres[rec.frames[0]])
        assert rec.pupil[0] * unit == pytest.approx(SHIFT, rel=0.2)


def test_the_unit_of_a_long_drive_is_not_that_of_its_rays() -> None:
    """Rays started by the pupil's shift in metres, in a map whose unit is the whole drive: of 5 m hardly a point was
    left, as of a profile that is five times off."""
    drive = driven(4, 5.0)
    rec = pf.reconstruct(drive.tracks, drive.camera, pupil_sigma=5e-5, diameter=SIZE)
    assert rec.status == "ok" and len(rec.frames) == len(drive.poses)
    assert len(rec.points) > 0.95 * len(np.unique(drive.tracks.track[drive.right]))
    central = pf.reconstruct(drive.tracks, drive.camera)
    assert len(central.frames) == len(drive.poses)


def test_a_long_drives_scale_is_found_from_a_map_that_was_built_without_the_pupil() -> None:
    """5 mm at 90 degrees make a map of 20 m of DN300 that was built through a central lens grow forty times from one
    end to the other: started from there the adjustment lost the drive, or held a shift of a tenth with a tiny sigma.
    Straightened it is near enough, by a nominal diameter that is 20 % off too."""
    drive = tube_drive(6, 20.0, density=500.0, ovality=0.0, camera=fisheye(95, pupil_e1=0.002))
    for size in (SIZE, 0.8 * SIZE):
        rec = pf.reconstruct(drive.tracks, drive.camera, pupil_sigma=5e-5, diameter=size)
        assert rec.status == "ok" and len(rec.frames) == len(drive.poses) and rec.iterations[0] <= 10
        unit = np.linalg.norm(drive.centres[-1] - drive.centres[0])
        assert rec.pupil[0] * unit == pytest.approx(0.002, abs=3 * shift_spread(rec) * unit)


def test_the_pupils_prior_is_of_the_map_as_it_is_adjusted_not_of_the_bent_one_it_was_built_as() -> None:
    """What the pixels tell and what the profile and the pipe's size tell, each with its weight, is what is found. With
    the unit of the bent map what was told beforehand was 28 % off over 30 m, which biased the shift by half a sigma."""
    camera = fisheye(95, pupil_e1=SHIFT)
    drive = tube_drive(1, 1.0, step=0.025, diameter=0.15, density=800.0, ovality=0.0, camera=camera)
    unit = np.linalg.norm(drive.centres[-1] - drive.centres[0])
    found = []
    for own in (5e-3, 5e-5):
        rec = pf.reconstruct(drive.tracks, drive.camera, pupil_sigma=own, diameter=0.15)
        prior = 1 / np.hypot(own, 0.2 * SHIFT) ** 2
        posterior = 1 / (shift_spread(rec) * unit) ** 2
        found.append((rec.pupil[0] * unit, prior, posterior))
    (free, wide, spread), (told, narrow, _) = found
    pixels = spread - wide
    alone = (free * spread - SHIFT * wide) / pixels
    expected = (alone * pixels + SHIFT * narrow) / (pixels + narrow)
    assert told == pytest.approx(expected, abs=0.02 / np.sqrt(pixels + narrow))


def test_a_narrow_pipe_is_measured_through_a_pupil_that_moves(tmp_path) -> None:
    """4 mm at 80 degrees beside a wall 60 mm away: as a central lens hardly an observation fits."""
    camera = fisheye(95, pupil_e1=0.002)
    drive = tube_drive(61, 1.0, step=0.02, diameter=0.12, density=1500.0, ovality=0.0, camera=camera)
    m = measured(tmp_path, drive, calibrated(camera, 0.002), diameter=0.12)
    error, sigma = held(m, 0.12)
    assert m.structure.status == "ok" and (np.abs(error) < 1.96 * sigma).mean() >= 0.9 and np.abs(error).max() < 0.03


def test_a_pupil_that_moves_is_no_zoom(tmp_path) -> None:
    """The check for a lens that zoomed looks through the same camera as the adjustment: by a shift in metres, in a unit
    of 3 m, this one was told to zoom at the third keyframe, and nothing behind that was measured."""
    drive = tube_drive(31, 3.0, density=400.0, camera=fisheye(95, pupil_e1=SHIFT))
    m = measured(tmp_path, drive, calibrated(drive.camera, SHIFT))
    assert m.structure.status == "ok" and len(m.structure.frames) == len(drive.poses)


@pytest.mark.parametrize("told", [SHIFT, 0.7 * SHIFT, None])
def test_without_an_encoder_stations_hold_the_truth_whatever_the_profile_says_of_its_pupil(tmp_path, told) -> None:
    """A calibration's shift, one that is 30 % less than it, none. Three drives each; stations of a drive are one taper,
    so that what is asked is that each drive is held at nine stations in ten. Intervals are no wider than a pupil that
    nobody knows asks (the taper by PUPIL_MOST), and narrower where it is known."""
    widths = []
    for seed in (61, 62, 63):
        drive = driven(seed)
        m = measured(tmp_path, drive, calibrated(drive.camera, told), diameter=SIZE)
        error, sigma = held(m)
        assert m.structure.status == "ok" and m.scale.diameter_from_prior
        assert (np.abs(error) < 1.96 * sigma).mean() >= 0.9
        widths.append(np.mean(sigma[[0, -1]]))
    limits = (0.015, 0.03) if told else (0.025, 0.06)
    assert limits[0] < np.mean(widths) < limits[1]


def test_a_profile_without_covariance_tapers_within_its_interval_too(tmp_path) -> None:
    """Its radius is 0.15 px off in the middle of the field, smoothly, as a fit of another model leaves it. Free within
    that residual it tapers three drives by 1.1 % (rms of the stations) where the profile, held, tapers them by 2.0 %;
    what is left is in the intervals."""
    scatter = []
    for seed in (61, 62, 63):
        drive = driven(seed)
        profile = dataclasses.replace(drive.camera, k2=drive.camera.k2 + 1e-3, k3=drive.camera.k3 - 4e-4, rms_px=0.15)
        m = measured(tmp_path, drive, profile, diameter=SIZE)
        error, sigma = held(m)
        scatter.append(error.std())
        assert (np.abs(error) < 1.96 * sigma).mean() >= 0.9 and m.measured[0].camera[0] > 0.003
        assert any("radial function as off by 0.15 px" in remark for remark in m.remarks)
    assert np.mean(scatter) < 0.016


@pytest.mark.parametrize("covariance", [True, False])
def test_behind_where_an_encoder_stopped_stations_hold_the_truth_though_the_profile_says_nothing_of_its_pupil(
    tmp_path, covariance
) -> None:
    """Read over the first fifth of 4 m: taken as the profile has it, none, the pupil's shift put the far end off by 20
    to 35 %, with a sigma of 4.6 %, and 6 to 13 of 55 stations held. It is estimated, in the wheel's metres. Where the
    encoder is read all along nothing is: there tracks' common errors would be read as a shift."""
    drive = driven(61, 4.0)
    profile = calibrated(drive.camera, None) if covariance else dataclasses.replace(drive.camera, pupil_e1=0.0)
    path = tmp_path / "a.mcap"
    write_survey(path, objects=objects_of(drive, profile=profile, encoder=True, nominal=SIZE))
    for read in (1.0, 0.2):
        survey = Survey.open(path)
        chainage = survey.chainage().copy()
        chainage[int(read * len(chainage)) :] = np.nan
        survey.chainage = lambda chainage=chainage: chainage  # type: ignore[method-assign]
        m = measure(survey, pictures=False, threads=2)
        error, sigma = held(m)
        assert m.structure.status == "ok" and m.scale.source == "encoder"
        assert (np.abs(error) < 1.96 * sigma).mean() >= 0.9 and np.abs(error).max() < 0.05
        assert bool(m.structure.pupil) == (read < 1) == (m.pupil_sigma == 0.0)
    assert m.structure.pupil == [pytest.approx(SHIFT, rel=0.2)]


def test_a_stretch_whose_pupil_is_held_counts_what_is_open_of_it_though_another_estimates_its_own(tmp_path) -> None:
    """The encoder stops in the second of two: its shift is in its stations' sigmas, in the first nothing told it."""
    drive = driven(14, 4.0)
    bare = (drive.tracks.frame >= 35) & (drive.tracks.frame <= 45)
    keep = ~bare | (np.random.default_rng(0).uniform(size=len(bare)) < 0.05)
    path = tmp_path / "a.mcap"
    write_survey(path, objects=objects_of(drive, keep=keep, profile=calibrated(drive.camera, None), nominal=SIZE))
    survey = Survey.open(path)
    chainage = survey.chainage().copy()
    chainage[55:] = np.nan
    survey.chainage = lambda: chainage  # type: ignore[method-assign]
    m = measure(survey, pictures=False, threads=2)
    assert m.structure.unit == "metre" and len(m.structure.pupil) == 2
    assert m.structure.pupil[0] == 0.0 and m.structure.pupil[1] == pytest.approx(SHIFT, rel=0.5)
    assert m.pupil_sigma > 0.0


def test_without_any_length_the_taper_is_within_its_interval_too(tmp_path) -> None:
    drive = driven(61)
    m = measured(tmp_path, drive, calibrated(drive.camera, SHIFT), nominal=0.0)
    error, sigma = held(m, 1.0)
    assert m.scale.unit == "diameter" and (np.abs(error) < 1.96 * sigma).mean() >= 0.9
    # In the unit of the measurement, and so in its document and for those who look through the camera.
    assert m.structure.pupil[0] * SIZE == pytest.approx(SHIFT, rel=0.3)
    document = document_of(m)
    assert document["structure"]["pupil_e1"] == m.structure.pupil and document["camera"]["pupil_e1"] == SHIFT
    assert measured_wall(m, document).camera.pupil_e1 == pytest.approx(m.structure.pupil[0])


def test_joints_scale_a_survey_whose_pupil_was_estimated_and_count_it_once(tmp_path) -> None:
    drive = tube_drive(31, 3.0, joints=0.5, density=400.0, camera=fisheye(95, pupil_e1=SHIFT))
    m = measured(tmp_path, drive, calibrated(drive.camera, SHIFT), joint_spacing=Known(0.5, 0.0005))
    error, sigma = held(m, SIZE)
    assert m.scale.source == "joints" and m.structure.unit == "arbitrary" and m.pupil_sigma == 0.0
    assert (np.abs(error) < 1.96 * sigma).mean() >= 0.9


def test_what_a_profile_leaves_open_of_its_pupil() -> None:
    camera = fisheye(95, pupil_e1=SHIFT)
    assert shift_sigma(calibrated(camera, SHIFT)) == pytest.approx(np.hypot(5e-5, 1e-5))
    assert shift_sigma(camera) == shift_sigma(calibrated(camera, None)) == pytest.approx(0.001, rel=0.03)


def test_a_refusal_without_an_encoder_says_what_to_do(tmp_path) -> None:
    """Of a wall that is seen on one side only: points there are, and no pipe."""
    drive = driven(61, 1.0)
    keep = drive.points[drive.tracks.track, 1] > 0.05
    path = tmp_path / "a.mcap"
    for encoder, nominal in ((False, 0.0), (False, SIZE), (True, SIZE)):
        path.unlink(missing_ok=True)
        write_survey(path, objects=objects_of(drive, keep=keep, encoder=encoder, nominal=nominal))
        with pytest.raises(PipefishError, match="no pipe around them") as caught:
            measure(Survey.open(path), pictures=False, threads=2)
        words = str(caught.value)
        assert "least squares" not in words and "wrong camera profile?" in words
        assert ("connect an encoder" in words) == (not encoder)
        assert ("--nominal" in words) == (not encoder and not nominal)
