"""A survey file of a simulated pipe: rendered keyframes, and tracks of true wall points with a little noise."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from PIL import Image

from pipefish import pipefish_pb2 as pb
from pipefish.simulate import Scene, fitted_camera
from pipefish.surveywrite import OBJECT_END, OBJECT_KEYFRAME, OBJECT_START
from synthetic import BOOT, SURVEY, Object, as_object, write_survey

COUNT = 0.0001  # metres of the encoder

# A pipe with a bend, an oval stretch, and white discs of known place.
DISC = 0.006
MARKS = [(0.55, 0.0), (0.6, 1.3), (0.66, 3.4), (0.75, 5.1), (0.84, 2.2), (0.9, 4.2), (0.97, 0.4), (1.05, 5.9)]
SCENE = {
    "diameter": 0.2,
    "pieces": [{"length": 0.6}, {"angle": 0.4, "radius": 0.8, "clock": 1.9}, {"length": 1.6}],
    "ovals": [{"start": 0.8, "end": 1.6, "ramp": 0.1, "ovality": 0.06, "clock": 0.6}],
    "markers": [{"s": s, "phi": phi, "radius": DISC} for s, phi in MARKS],
    "texture": {"contrast": 0.5, "wetness": 0.0},
    "lens": {"width": 400, "height": 400, "circle_radius": 195, "c_u": 199.5, "c_v": 199.5},
    "motion": {"frames": 60, "start": 0.4, "speed": 0.5, "ramp": 0.05},
}
FRAMES = np.arange(0, 31)  # 25 mm from one to the next


def fill_observations(obs: pb.Observations, ids: np.ndarray, pixels: np.ndarray, sigma: float) -> None:
    """Tracks of one keyframe, ids ascending from 1; sigma in pixels."""
    obs.id_delta.extend(np.diff(ids, prepend=0).tolist())
    xy = np.round(pixels * 65536).astype(int)
    obs.x_q16.extend(xy[:, 0].tolist())
    obs.y_q16.extend(xy[:, 1].tolist())
    for name, value in (("cov_xx_q20", round(sigma**2 * 2**20)), ("cov_xy_q20", 0)):
        getattr(obs, name).extend([value] * len(ids))
    obs.cov_yy_q20.extend(obs.cov_xx_q20)
    obs.age.extend([5] * len(ids))
    obs.quality.extend([32000] * len(ids))
    obs.status.extend([2] * len(ids))


def rendered_objects(scene: Scene, frames: np.ndarray, points: int = 1500, sigma: float = 0.15) -> list[Object]:
    """Start, a keyframe for each of the frames, end."""
    random = np.random.default_rng(5)
    camera = fitted_camera(scene)
    s = [scene.arc_length(int(f)) for f in frames]
    places = zip(random.uniform(s[0], s[-1] + 0.4, points), random.uniform(0, 2 * np.pi, points), strict=True)
    wall = np.array([scene.wall(a, phi) for a, phi in places if a < scene.length])
    begin = pb.SurveyStart(survey_id=SURVEY, name="rendered pipe", software="test", width=camera.width)
    begin.height, begin.nominal_diameter_m = camera.height, scene.spec["diameter"]
    begin.time.boot_id, begin.profile = BOOT, camera.to_binary()
    begin.encoder.metres_per_count, begin.encoder.metres_per_count_sigma = COUNT, 0.001 * COUNT
    objects = [as_object(OBJECT_START, begin)]
    driven = np.array([scene.driven(int(f)) for f in frames])
    for index, frame in enumerate(int(f) for f in frames):
        pixels, seen = scene.visible(frame, wall)
        pixels = pixels + random.normal(0, sigma, pixels.shape)
        message = pb.Keyframe(survey_id=SURVEY, index=index, frame_sequence=frame, cause=2, after_break=index == 0)
        message.width, message.height = camera.width, camera.height
        picture = io.BytesIO()
        Image.fromarray(scene.render(frame)).save(picture, "JPEG", quality=92)
        message.jpeg = picture.getvalue()
        message.time.boot_id, message.time.monotonic_ns = BOOT, 10**9 + index * 2 * 10**8
        message.telemetry.encoder_count = round((driven[index] - driven[0]) / COUNT)
        message.telemetry.roll_rad, message.telemetry.pitch_rad = scene.attitude(frame)
        message.telemetry.attitude_sigma_rad = 0.003
        fill_observations(message.observations, np.flatnonzero(seen) + 1, pixels[seen], sigma)
        objects.append(as_object(OBJECT_KEYFRAME, message))
    finish = pb.SurveyEnd(survey_id=SURVEY, keyframes=len(frames), frames=5 * len(frames), boots=1, reason="done")
    return [*objects, as_object(OBJECT_END, finish)]


def rendered_survey(scene: Scene, frames: np.ndarray, path: Path, **more: float) -> Path:
    """The survey file."""
    write_survey(path, objects=rendered_objects(scene, frames, **more))
    return path
