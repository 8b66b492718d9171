"""The full model through Camera: derivatives in the order of PARAMETERS, ray origins, the image circle."""

import dataclasses
import math

import numpy as np
import pytest

import pipefish as pf


@pytest.fixture
def full():
    """Every term in use that can be together."""
    return pf.Camera(
        width=1280, height=800, f_u=356.2, f_v=355.9, c_u=647.3, c_v=404.8, skew=0.3, theta_max=1.6,
        k2=-0.031, k3=0.0042, k4=-0.0011, k5=0.00006, tilt=(0.01, -0.02), pupil_e1=-0.0008,
        asym_radial_theta=(0.001, -0.0005, 0.0002), asym_radial_phi=(0.5, 0.5, -0.5, 0.5),
        asym_tangential_theta=(0.0006, 0.0002, -0.0001), asym_tangential_phi=(0.6, 0, 0.8, 0),
        cpoly=(1e-4, -2e-4, 3e-4, 1e-4, -1e-4, 2e-4, 1e-4, 3e-4, -1e-4, 1e-4, 2e-4, -2e-4, 1e-4, -1e-4),
        circle_u=640, circle_v=400, circle_radius=560,
    )  # fmt: skip


def changed(camera, name, step):
    key, _, rest = name.partition("[")
    if not rest:
        return dataclasses.replace(camera, **{key: getattr(camera, key) + step})
    values = list(getattr(camera, key))
    values[int(rest[:-1])] += step
    return dataclasses.replace(camera, **{key: tuple(values)})


def test_jacobian_has_the_order_of_the_parameters_and_the_values_of_differences(full):
    rng = np.random.default_rng(4)
    points = rng.normal(size=(40, 3)) + np.array([0, 0, 1.5])
    pixels, ok, by_point, by_parameter = full.project_jacobian(points)
    assert by_point.shape == (40, 2, 3) and by_parameter.shape == (40, 2, len(pf.PARAMETERS))
    np.testing.assert_array_equal(pixels, full.project(points)[0])
    assert ok.sum() > 20 and np.isnan(by_parameter[~ok]).all() and np.isnan(by_point[~ok]).all()
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        difference = (full.project(points + step)[0] - full.project(points - step)[0]) / 2e-6
        inside = ok & np.isfinite(difference).all(axis=1)
        np.testing.assert_allclose(by_point[inside, :, axis], difference[inside], atol=1e-5)
    for i, name in enumerate(pf.PARAMETERS):
        if "_phi" in name or name == "mirror":  # of unit norm, of another family: no step of their own
            continue
        a, b = (changed(full, name, s).project(points)[0] for s in (1e-6, -1e-6))
        inside = ok & np.isfinite(a + b).all(axis=1)
        np.testing.assert_allclose(by_parameter[inside, :, i], (a - b)[inside] / 2e-6, atol=2e-5, err_msg=name)


def test_origins_follow_the_pupil_and_rays_from_them_project_back(full):
    pixels = np.array([[647.3, 404.8], [300, 250], [900, 600], [1e5, 0]])
    rays, ok = full.unproject(pixels)
    origins = full.origins(pixels)
    assert ok.tolist() == [True, True, True, False] and np.isnan(origins[3]).all()
    theta = np.arccos(rays[:3, 2])
    np.testing.assert_allclose(origins[:3], np.stack([0 * theta, 0 * theta, -0.0008 * theta**2], axis=1), atol=1e-12)
    for distance in (0.05, 1.0, 100.0):
        again, back = full.project(origins[:3] + distance * rays[:3])
        assert back.all()
        np.testing.assert_allclose(again, pixels[:3], atol=1e-9)
    central = dataclasses.replace(full, pupil_e1=0.0)
    assert not central.origins(pixels).any()


def test_in_image_is_sensor_and_circle(full):
    pixels = [[640, 400], [-0.6, 400], [640, -0.5], [1279.4, 400], [1199, 400], [1201, 400], [math.nan, 0]]
    assert full.in_image(pixels).tolist() == [True, False, True, False, True, False, False]
