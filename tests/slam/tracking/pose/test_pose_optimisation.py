"""Motion-only optimisation: Jacobian, convergence with outliers, consistency, frames."""

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_view import CAMERA, T_NEW_OLD, points_before

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.tracking.pose.pose_optimisation import (
    PoseOptimisationConfig,
    jacobian,
    median,
    optimise_pose,
    residuals,
)
from bmask_slam.tracking.pose.reprojection import Reprojection, moved

T_WORLD_CAMERA = se3_exp(np.array([0.2, -0.5, 0.1, 1.0, -2.0, 0.5]))
SIGMAS_PX = np.array([0.7, 0.7, 0.12])


def measure(points_world: Array, noise_px: Array | None = None) -> Array:
    """u, v, disparity (N, 3) of points from the true pose, by the camera's own stereo model."""
    stereo = CAMERA.project_stereo(transform(inverse(T_WORLD_CAMERA), points_world))
    exact = np.column_stack([stereo[:, :2], stereo[:, 0] - stereo[:, 2]])
    return exact if noise_px is None else exact + noise_px


def scene(count: int, rng: np.random.Generator, mono_share: float = 0.0) -> tuple[Array, Array]:
    """Points in view and their noisy measurements."""
    points = points_before(T_WORLD_CAMERA, count, rng)
    measured = measure(points, rng.normal(size=(count, 3)) * SIGMAS_PX)
    measured[rng.random(count) < mono_share, 2] = np.nan
    return points, measured


def sigmas(count: int) -> Array:
    return np.tile(SIGMAS_PX, (count, 1))


def prediction(rng: np.random.Generator, angle_deg: float = 3.0, shift_m: float = 0.1) -> Array:
    """The true pose, turned and shifted by this much in random directions."""
    axes = rng.normal(size=(2, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return T_WORLD_CAMERA @ se3_exp(np.r_[np.deg2rad(angle_deg) * axes[0], shift_m * axes[1]])


def test_residuals_are_predicted_minus_measured() -> None:
    points = points_before(T_WORLD_CAMERA, 20, np.random.default_rng(0))
    offset = np.array([1.0, -2.0, 0.5])
    r, points_camera = residuals(T_WORLD_CAMERA, points, measure(points) - offset, CAMERA)
    np.testing.assert_allclose(r, np.tile(offset, (20, 1)), atol=1e-9)
    back = transform(T_WORLD_CAMERA, points_camera)
    np.testing.assert_allclose(back, points, atol=1e-12)


def test_the_jacobian_equals_finite_differences() -> None:
    points = points_before(T_WORLD_CAMERA, 20, np.random.default_rng(1))
    z = np.zeros((20, 3))
    _, points_camera = residuals(T_WORLD_CAMERA, points, z, CAMERA)
    h = 1e-6
    columns = [
        (
            residuals(T_WORLD_CAMERA @ se3_exp(h * e), points, z, CAMERA)[0]
            - residuals(T_WORLD_CAMERA @ se3_exp(-h * e), points, z, CAMERA)[0]
        )
        / (2 * h)
        for e in np.eye(6)
    ]
    np.testing.assert_allclose(
        jacobian(points_camera, CAMERA), np.stack(columns, axis=2), rtol=1e-6, atol=1e-4
    )


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("mono_share", [0.0, 0.5, 1.0])
def test_exact_measurements_give_the_exact_pose(seed: int, mono_share: float) -> None:
    rng = np.random.default_rng(seed)
    points = points_before(T_WORLD_CAMERA, 60, rng)
    measured = measure(points)
    measured[rng.random(60) < mono_share, 2] = np.nan
    estimate = optimise_pose(prediction(rng), points, measured, sigmas(60), CAMERA)
    assert estimate.ok
    assert estimate.inliers.all()
    np.testing.assert_allclose(estimate.T_world_camera, T_WORLD_CAMERA, atol=1e-7)


@pytest.mark.parametrize("seed", range(10))
def test_one_third_outliers_do_not_change_the_pose(seed: int) -> None:
    """30 % wrong by up to 60 px and a metre, from a prediction 3 degrees and 10 cm off."""
    rng = np.random.default_rng(100 + seed)
    points, measured = scene(150, rng, mono_share=0.2)
    outlier = np.arange(150) < 45
    shift = rng.uniform(10, 60, (45, 2)) * rng.choice([-1, 1], (45, 2))
    measured[:45, :2] += shift
    measured[:45, 2] *= rng.uniform(0.7, 1.4, 45)
    estimate = optimise_pose(prediction(rng), points, measured, sigmas(150), CAMERA)
    clean = optimise_pose(T_WORLD_CAMERA, points[45:], measured[45:], sigmas(105), CAMERA)
    assert estimate.ok
    assert not estimate.inliers[outlier].any()
    assert estimate.inliers[~outlier].mean() > 0.85
    moved = se3_log(inverse(clean.T_world_camera) @ estimate.T_world_camera)
    one_point_at_the_gate = 7.815 * 6 / 105  # chi-square times the mean leverage
    assert moved @ clean.information @ moved < one_point_at_the_gate
    xi = se3_log(inverse(T_WORLD_CAMERA) @ estimate.T_world_camera)
    assert np.linalg.norm(xi[:3]) < np.deg2rad(0.15)
    assert np.linalg.norm(xi[3:]) < 0.01


@pytest.mark.parametrize("mono_share", [0.0, 0.6])
def test_information_is_consistent_with_the_errors(mono_share: float) -> None:
    """NEES with a wide gate: chi-square with 6 degrees of freedom a run.

    The 95 % gate takes the tails, which costs a few per cent of information and of error alike.
    """
    nees, share = [], []
    for seed in range(150):
        rng = np.random.default_rng(1000 + seed)
        points, measured = scene(80, rng, mono_share)
        estimate = optimise_pose(prediction(rng, 0.5, 0.02), points, measured, sigmas(80), CAMERA)
        xi = se3_log(inverse(estimate.T_world_camera) @ T_WORLD_CAMERA)
        nees.append(xi @ estimate.information @ xi)
        share.append(estimate.inliers.mean())
    low, high = chi2.ppf([0.005, 0.995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < 1.08 * high
    assert 0.94 < np.mean(share) < 0.97


def test_pose_moves_with_the_world() -> None:
    rng = np.random.default_rng(4)
    points, measured = scene(80, rng, mono_share=0.3)
    start = prediction(rng)
    here = optimise_pose(start, points, measured, sigmas(80), CAMERA)
    there = optimise_pose(
        T_NEW_OLD @ start, transform(T_NEW_OLD, points), measured, sigmas(80), CAMERA
    )
    np.testing.assert_allclose(there.T_world_camera, T_NEW_OLD @ here.T_world_camera, atol=1e-7)
    np.testing.assert_array_equal(there.inliers, here.inliers)
    np.testing.assert_allclose(there.information, here.information, rtol=1e-4, atol=1e-1)


def test_sigmas_are_weights() -> None:
    """The same points measured twice: sigmas of 1 and 10 weigh 100 to 1."""
    rng = np.random.default_rng(5)
    points = np.tile(points_before(T_WORLD_CAMERA, 100, rng), (2, 1))
    other = T_WORLD_CAMERA @ se3_exp(np.array([0.0, 0.002, 0.0, 0.0, 0.0, 0.0]))
    measured = measure(points)
    half = np.arange(200) < 100
    stereo = CAMERA.project_stereo(transform(inverse(other), points[half]))
    measured[half] = np.column_stack([stereo[:, :2], stereo[:, 0] - stereo[:, 2]])
    weights = sigmas(200)
    weights[half] *= 10.0
    estimate = optimise_pose(T_WORLD_CAMERA, points, measured, weights, CAMERA)
    xi = se3_log(inverse(T_WORLD_CAMERA) @ estimate.T_world_camera)
    assert xi[1] == pytest.approx(0.002 / 101, rel=0.02)


def test_depth_is_observed_through_disparity_alone() -> None:
    """A step along the axis towards points near the axis: it changes disparity, hardly pixels."""
    rng = np.random.default_rng(6)
    z = rng.uniform(1.0, 3.0, 40)
    pixels = rng.uniform([310.0, 235.0], [327.0, 248.0], (40, 2))
    points = transform(T_WORLD_CAMERA, CAMERA.backproject(pixels, z))
    start = T_WORLD_CAMERA @ se3_exp(np.array([0, 0, 0, 0, 0, 0.05]))
    estimate = optimise_pose(start, points, measure(points), sigmas(40), CAMERA)
    np.testing.assert_allclose(estimate.T_world_camera, T_WORLD_CAMERA, atol=1e-6)


@pytest.mark.parametrize("count", [0, 3, 5])
def test_too_few_points_give_no_pose(count: int) -> None:
    rng = np.random.default_rng(7)
    points = points_before(T_WORLD_CAMERA, count, rng)
    estimate = optimise_pose(T_WORLD_CAMERA, points, measure(points), sigmas(count), CAMERA)
    assert not estimate.ok


def test_one_repeated_point_gives_no_pose() -> None:
    points = np.repeat(points_before(T_WORLD_CAMERA, 1, np.random.default_rng(8)), 30, axis=0)
    assert not optimise_pose(T_WORLD_CAMERA, points, measure(points), sigmas(30), CAMERA).ok


def test_points_behind_the_camera_are_not_inliers() -> None:
    rng = np.random.default_rng(9)
    points = points_before(T_WORLD_CAMERA, 60, rng)
    measured = measure(points)
    mirrored = transform(inverse(T_WORLD_CAMERA), points[:10]) * -1.0
    points[:10] = transform(T_WORLD_CAMERA, mirrored)
    estimate = optimise_pose(T_WORLD_CAMERA, points, measured, sigmas(60), CAMERA)
    assert estimate.ok
    np.testing.assert_array_equal(estimate.inliers, np.arange(60) >= 10)


def test_nan_measurements_give_no_pose() -> None:
    """Random measurements: few inliers, or no pose."""
    rng = np.random.default_rng(10)
    points = points_before(T_WORLD_CAMERA, 100, rng)
    nonsense = np.column_stack(
        [rng.uniform([0, 0], [640, 480], (100, 2)), rng.uniform(10, 40, 100)]
    )
    estimate = optimise_pose(T_WORLD_CAMERA, points, nonsense, sigmas(100), CAMERA)
    assert not estimate.ok or estimate.inliers.sum() < 12


def test_the_pose_is_a_rigid_transform() -> None:
    rng = np.random.default_rng(11)
    points, measured = scene(80, rng)
    T = optimise_pose(
        prediction(rng), points, measured, sigmas(80), CAMERA, PoseOptimisationConfig()
    ).T_world_camera
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-14)
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


@pytest.mark.parametrize("count", [1, 2, 7, 10])
def test_the_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)


def test_the_fast_normal_equations_equal_those_of_the_jacobian() -> None:
    rng = np.random.default_rng(5)
    points, measured = scene(50, rng)
    weight = rng.uniform(0.1, 4.0, (50, 3))
    weight[::3, 2] = 0.0
    kernel = rng.uniform(5.0, 50.0, 50)
    r, points_camera = residuals(T_WORLD_CAMERA, points, measured, CAMERA)
    J = jacobian(points_camera, CAMERA)
    chi2 = (r**2 * weight).sum(axis=1)
    matches = Reprojection.of(points, measured, weight, CAMERA)
    squares, z = matches.squares(T_WORLD_CAMERA)
    np.testing.assert_allclose((squares * matches.weight).sum(axis=0), chi2, rtol=1e-9)
    np.testing.assert_allclose(z, points_camera[:, 2])
    for cauchy, factor in ((None, 1.0), (kernel, kernel / (kernel + chi2))):
        w = weight * np.reshape(factor, (-1, 1))
        H, g = matches.normal_equations(T_WORLD_CAMERA, cauchy)
        slow_H = np.einsum("nij,nik,ni->jk", J, J, w)
        np.testing.assert_allclose(H, slow_H, rtol=1e-8, atol=1e-8 * slow_H.max())
        np.testing.assert_allclose(g, np.einsum("nij,ni,ni->j", J, r, w), rtol=1e-7)


def test_a_step_moves_the_pose_by_its_tangent() -> None:
    step = 1e-5 * np.array([1.0, -2.0, 0.5, 3.0, -1.0, 2.0])
    expected = T_WORLD_CAMERA @ se3_exp(step)
    np.testing.assert_allclose(moved(T_WORLD_CAMERA, step), expected, atol=1e-9)
    R = moved(T_WORLD_CAMERA, 1e4 * step)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
