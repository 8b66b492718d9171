"""What is taken for what a profile does not say of its camera: stated, not hidden.

A lens whose elements are tilted or decentred by hundredths of a millimetre makes any pipe oval by some
hundredths of a point, everywhere alike, and no straight drive shows it."""

from __future__ import annotations

import dataclasses

import numpy as np

from .camera import PARAMETERS, Camera
from .lens_ripple import RADIAL, ripple_covariance

#: Pixels, of a profile that does not say what its calibration left: between the 0.1 and 0.5 that calibrations of wide
#: lenses leave.
RESIDUAL_PX = 0.3
RESIDUAL_LEAST_PX = 0.02
#: All that is not the radial function. Along that a survey's scale bends, and what a profile is off there cannot be
#: said from a residual: a wrong one leaves as little. Where no encoder holds the scale it is free within that residual
#: all the same: held, a lens that is 0.1 px off tapers a metre of DN150 by 6 %.
ASYMMETRY = ("c_u", "c_v", *(f"cpoly[{i}]" for i in range(14)))
#: Metres of e1, of a profile that does not say how well it knows its pupil's shift: 95 % of lenses shift less. Two
#: millimetres at 57 degrees, five at 90; traced and calibrated fisheyes have one to three at 90.
PUPIL_MOST = 0.002
#: And of one that does: e1's sigma by a pupil that moves otherwise than by e1 theta^2. It is a tenth of a per cent of a
#: DN300's diameter (95 %), as a calibration's verdict has it. Of the simulator's traced pupil, and of Gennery's law,
#: a calibration leaves up to 0.22 mm, at 65 degrees; ripples hold the rest.
PUPIL_REST = 5e-5
RINGS, AROUND = 16, 36


def assumed_px(camera: Camera) -> float:
    """Pixels by which such a profile counts as off, rms over the field: as much as its calibration left."""
    return RESIDUAL_PX if camera.rms_px is None else max(camera.rms_px, RESIDUAL_LEAST_PX)


def _with_the_unknown(camera: Camera, metric: bool) -> Camera:
    """With ripples and the pupil's rest beside its covariance, where lengths are known; else without the pupil. Of
    other radial functions than the polynomial nothing is added."""
    assert camera.covariance is not None
    own = camera.covariance_parameters
    kept = [i for i, name in enumerate(own) if metric or name != "pupil_e1"]
    told, own = camera.covariance[np.ix_(kept, kept)], tuple(own[i] for i in kept)
    if camera.radial != "generic":
        return dataclasses.replace(camera, covariance=told if own else None, covariance_parameters=own)
    names = tuple(name for name in PARAMETERS if name in own or name in RADIAL)
    out = np.zeros((len(names), len(names)))
    stated, radial = ([names.index(name) for name in some] for some in (own, RADIAL))
    out[np.ix_(stated, stated)] = told
    out[np.ix_(radial, radial)] += ripple_covariance(camera, camera.theta_covered or camera.theta_max)
    if "pupil_e1" in own:
        out[names.index("pupil_e1"), names.index("pupil_e1")] += PUPIL_REST**2
    return dataclasses.replace(camera, covariance=out, covariance_parameters=names)


def assumed(camera: Camera, metric: bool = True) -> Camera:
    """The camera with a covariance: its own and that of what no profile knows of its lens, or, where it has none, of
    its ASYMMETRY. metric: lengths are known; else nothing is said of the pupil, whose shift is one, and which the
    adjustment estimates in its own unit.

    Without its own the profile's error is taken for a field of that family whose rms over the picture is assumed_px()
    and whose directions move the picture by as much each; without lengths the radius is as far off, too, smoothly, of
    a radial function that is the polynomial."""
    if camera.covariance is not None:
        return _with_the_unknown(camera, metric)
    chosen = [PARAMETERS.index(name) for name in ASYMMETRY]
    end = camera.theta_covered or camera.theta_max
    # Rings of equal area in the picture, about.
    theta = end * np.sqrt((np.arange(RINGS) + 0.5) / RINGS)[:, None]
    phi = np.arange(AROUND) * (2 * np.pi / AROUND)
    rays = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    pixels, ok, _, by_parameter = camera.project_jacobian(np.stack(rays, axis=-1).reshape(-1, 3))
    inside = ok & (pixels >= 0).all(axis=1) & (pixels <= [camera.width - 1, camera.height - 1]).all(axis=1)
    rows = by_parameter[inside][:, :, chosen].reshape(-1, len(chosen))
    scale = np.linalg.norm(rows, axis=0)
    _, size, directions = np.linalg.svd(rows / scale, full_matrices=False)
    # A residual is a distance: along either axis it is less by the root of two.
    spread = (directions.T / size) * (assumed_px(camera) * np.sqrt(0.5 * len(rows) / len(chosen))) / scale[:, None]
    if metric or camera.radial != "generic":
        return dataclasses.replace(camera, covariance=spread @ spread.T, covariance_parameters=ASYMMETRY)
    names = tuple(name for name in PARAMETERS if name in RADIAL or name in ASYMMETRY)
    radial, other = ([names.index(name) for name in some] for some in (RADIAL, ASYMMETRY))
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(radial, radial)] = ripple_covariance(camera, end, assumed_px(camera))
    whole[np.ix_(other, other)] = spread @ spread.T
    return dataclasses.replace(camera, covariance=whole, covariance_parameters=names)
