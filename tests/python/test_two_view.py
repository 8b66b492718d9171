"""Two views on rays: solvers, distances, robust estimate, degenerate motions."""

from __future__ import annotations

import numpy as np
import pytest

import pipefish as pf
from pipefish import _engine
from tube_tracks import Pair, fisheye, pair_bound, rotation, tube_pair


def unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


def cross_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The small rotation vector of a b^T."""
    w = a @ b.T
    return np.array([w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1]]) / 2


def test_five_points_all_around_the_sphere_give_the_true_essential_matrix() -> None:
    random = np.random.default_rng(1)
    worst = []
    for _ in range(200):
        turn, t = rotation(random.normal(0, 1, 3)), unit(random.normal(0, 1, (1, 3)))[0]
        points = random.normal(0, 2, (5, 3))
        f1, f2 = unit(points), unit(points @ turn.T + t)
        true = cross_matrix(t) @ turn / np.sqrt(2)
        found = _engine.five_point(f1, f2)
        worst.append(min(min(np.abs(e - true).max(), np.abs(e + true).max()) for e in found))
        for e in found:
            assert np.abs(np.einsum("ki,ij,kj->k", f2, e, f1)).max() < 1e-9
    assert np.median(worst) < 1e-12
    assert np.sum(np.array(worst) > 1e-7) <= 2, "five points near a degenerate configuration may lose their digits"


def test_three_points_all_around_the_sphere_give_the_true_pose() -> None:
    random = np.random.default_rng(2)
    worst = []
    for _ in range(300):
        turn, t = rotation(random.normal(0, 1, 3)), random.normal(0, 1, 3)
        points = random.normal(0, 2, (3, 3))
        found = _engine.three_point(unit(points @ turn.T + t), points)
        worst.append(min(np.abs(pose - np.column_stack([turn, t])).max() for pose in found))
    assert np.median(worst) < 1e-12
    assert np.sum(np.array(worst) > 1e-7) <= 2


def test_sampson_distance_of_exact_pairs_is_zero_and_of_noise_is_chi_square_at_every_angle() -> None:
    random = np.random.default_rng(3)
    camera = fisheye(105)
    pair = tube_pair(0, (0.02, 0.01, 0.05), 10_000, 0.0, limits=(10, 103), camera=camera)
    pose = np.column_stack([pair.rotation, -pair.rotation @ pair.centre])
    exact = _engine.sampson_squared(camera._profile, pose, *pair.exact, 0.3)
    assert np.sqrt(exact).max() < 2e-12  # sigmas: a pixel's last digit is 4e-13 of them
    noisy = [uv + random.normal(0, 0.3, uv.shape) for uv in pair.exact]
    squared = _engine.sampson_squared(camera._profile, pose, *noisy, 0.3)
    assert abs(squared.mean() - 1) < 0.05
    theta = np.arctan2(np.hypot(*pair.points[:, :2].T), pair.points[:, 2])
    for low in range(15, 95, 20):
        inside = (np.radians(low) < theta) & (theta < np.radians(low + 20))
        assert abs(squared[inside].mean() - 1) < max(0.1, 4 * np.sqrt(2 / inside.sum())), f"theta from {low} degrees"


def test_angle_of_rays_to_meet_is_the_smaller_eigenvalue_over_epipolar_planes() -> None:
    random = np.random.default_rng(4)
    for _ in range(50):
        turn, t = rotation(random.normal(0, 1, 3)), unit(random.normal(0, 1, (1, 3)))[0]
        f1, f2 = unit(random.normal(0, 1, (2, 3)))
        g = turn @ f1
        # A plane through the baseline with unit normal n: the squared sines are (n.g)^2 + (n.f2)^2, n across t.
        basis = np.linalg.svd(t[None])[2][1:]
        least = np.linalg.eigvalsh(basis @ (np.outer(g, g) + np.outer(f2, f2)) @ basis.T)[0]
        value = _engine.ray_angles_squared(cross_matrix(t) @ turn, f1[None], f2[None])
        assert value == pytest.approx(least, rel=1e-10, abs=1e-15)


@pytest.mark.parametrize(
    ("motion", "limits"),
    [
        ((0.003, 0.002, 0.05), (15, 88)),
        ((0.003, 0.002, 0.05), (15, 103)),
        ((0.03, 0.0, 0.002), (15, 88)),
        ((0.03, 0.0, 0.002), (15, 103)),
    ],
    ids=["forward", "forward beyond 90", "sideways", "sideways beyond 90"],
)
def test_pose_in_a_tube_is_as_good_as_its_inliers_allow(
    motion: tuple[float, float, float], limits: tuple[float, float]
) -> None:
    """300 points, 30 % wrong, 0.3 px: errors whitened by the Cramer-Rao bound of the right pairs, rms over 100 runs."""
    runs = 100
    turns, directions, own = [], [], []
    for seed in range(runs):
        pair = tube_pair(seed, motion, limits=limits, camera=fisheye(105))
        found = pf.two_view(pair.camera, *pair.pixels, seed=seed)
        assert found.status == "ok"
        bound, bound_direction = pair_bound(pair)
        t = -pair.rotation @ pair.centre / np.linalg.norm(pair.centre)
        w, d = turn_between(found.rotation, pair.rotation), found.direction - t
        turns.append(w @ np.linalg.solve(bound, w) / 3)
        directions.append(d @ np.linalg.pinv(bound_direction, rcond=1e-6) @ d / 2)
        own.append(np.trace(found.covariance[:3, :3]) / np.trace(bound))
        assert (found.inlier & pair.right).sum() > 0.95 * pair.right.sum()
        assert (found.inlier & ~pair.right).sum() <= 4
    # Two standard errors of such a mean over the runs, chi^2 with 3 and 2 degrees of freedom.
    assert np.sqrt(np.mean(turns)) < 1.1 * (1 + np.sqrt(2 / 3 / runs))
    assert np.sqrt(np.mean(directions)) < 1.1 * (1 + np.sqrt(1 / runs))
    assert np.median(own) == pytest.approx(1, abs=0.15), "the stated covariance is that of the bound"


def test_result_depends_on_the_seed_alone() -> None:
    pair = tube_pair(5, (0.0, 0.0, 0.05))
    first, again = (pf.two_view(pair.camera, *pair.pixels, seed=7) for _ in range(2))
    assert first.cam2_from_cam1.tobytes() == again.cam2_from_cam1.tobytes()
    assert (first.inlier == again.inlier).all()


def test_rotation_alone_is_recognised() -> None:
    for seed in range(100):
        pair = tube_pair(seed, (0.0, 0.0, 0.0))
        found = pf.two_view(pair.camera, *pair.pixels, seed=seed)
        assert found.status == "no_baseline"
        assert np.linalg.norm(turn_between(found.rotation, pair.rotation)) < np.radians(0.1)
        assert (found.direction == 0).all()


def plane_pair(seed: int) -> Pair:
    random = np.random.default_rng(seed)
    camera, turn, centre = fisheye(), rotation(random.normal(0, 0.05, 3)), np.array([0.03, 0.01, 0.01])
    points = np.column_stack([random.uniform(-0.3, 0.3, (300, 2)), np.full(300, 0.2)])
    exact = (camera.project(points)[0], camera.project((points - centre) @ turn.T)[0])
    pixels = tuple(uv + random.normal(0, 0.3, uv.shape) for uv in exact)
    return Pair(camera, turn, centre, points, exact, pixels, np.ones(300, bool))


def test_plane_is_recognised_and_a_tube_is_none() -> None:
    for seed in range(30):
        pair = plane_pair(seed)
        assert pf.two_view(pair.camera, *pair.pixels, seed=seed).status == "plane"


def test_too_few_and_meaningless_pairs_are_a_status() -> None:
    pair = tube_pair(1, (0.0, 0.0, 0.05))
    few = pf.two_view(pair.camera, pair.pixels[0][:7], pair.pixels[1][:7])
    assert few.status == "too_few" and not few.inlier.any()
    outside = np.full((50, 2), 1e5)
    assert pf.two_view(pair.camera, outside, outside).status == "too_few"
    assert pf.two_view(pair.camera, np.full((50, 2), np.nan), outside).status == "too_few"
    still = pf.two_view(pair.camera, pair.pixels[0], pair.pixels[0])
    assert still.status == "no_baseline"


def test_wrong_arrays_are_named() -> None:
    pair = tube_pair(1, (0.0, 0.0, 0.05), 20)
    with pytest.raises(pf.ArgumentError, match="pixels1, pixels2: 20 and 19 rows"):
        pf.two_view(pair.camera, pair.pixels[0], pair.pixels[1][1:])
    with pytest.raises(pf.ArgumentError, match="covariance2"):
        pf.two_view(pair.camera, *pair.pixels, covariance2=np.eye(2))
    with pytest.raises(pf.ArgumentError, match="sigma"):
        pf.two_view(pair.camera, *pair.pixels, sigma=0.0)
