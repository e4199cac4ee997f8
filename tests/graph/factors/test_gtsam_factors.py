"""Conversion of arrays to GTSAM factors: order, frame and sign."""

import gtsam
import numpy as np
import pytest
from synthetic_room import CAMERA, make_room, noisy

from bmask_slam.graph.factors.checks import reprojection
from bmask_slam.graph.factors.graph_update import Observations, PosePrior, RelativePose
from bmask_slam.graph.factors.gtsam_factors import FactorMaker, make_graph, make_values, read_values
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys, variable_named_in
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform

RNG = np.random.default_rng(3)
T_WORLD_CAMERA = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, -2.0, 0.7]))
POINT_WORLD = transform(T_WORLD_CAMERA, np.array([[0.4, -0.3, 2.5]]))[0]
OFFSET_PX = np.array([1.5, -2.5, 0.8])
SIGMAS_PX = np.array([0.5, 1.0, 2.0])  # of u, v and disparity
SIGMA_RIGHT_PX = np.hypot(0.5, 2.0)  # u_right = u_left - disparity carries both errors
COVARIANCE_PX2 = np.array([[0.25, 0.0, 0.25], [0.0, 1.0, 0.0], [0.25, 0.0, SIGMA_RIGHT_PX**2]])


def chi2_of_offset(mono: bool) -> float:
    """Squared Mahalanobis length of OFFSET_PX under the covariance of (u_left, v, u_right)."""
    rows = slice(0, 2 if mono else 3)
    offset = OFFSET_PX[rows]
    return float(offset @ np.linalg.solve(COVARIANCE_PX2[rows, rows], offset))


def one_observation(mono: bool) -> Observations:
    z = CAMERA.project_stereo(np.array([0.4, -0.3, 2.5])) - OFFSET_PX
    if mono:
        z[2] = np.nan
    return Observations(np.array([7]), np.array([9]), z[None], SIGMAS_PX[None])


def values_at(T: np.ndarray, point: np.ndarray) -> gtsam.Values:
    return make_values(np.array([7]), T[None], np.array([9]), point[None])


@pytest.mark.parametrize("mono", [False, True])
def test_error_is_half_the_squared_whitened_residual(mono: bool) -> None:
    (factor,) = FactorMaker(CAMERA, SmootherConfig(robust=False)).observations(
        one_observation(mono)
    )
    error = factor.error(values_at(T_WORLD_CAMERA, POINT_WORLD))
    assert error == pytest.approx(0.5 * chi2_of_offset(mono), rel=1e-9)


def test_stereo_error_is_that_of_independent_pixel_and_disparity() -> None:
    """The same chi-square as three independent residuals u, v and u_left - u_right."""
    disparity_offset = OFFSET_PX[0] - OFFSET_PX[2]
    independent = np.array([OFFSET_PX[0], OFFSET_PX[1], disparity_offset]) / SIGMAS_PX
    assert chi2_of_offset(mono=False) == pytest.approx(np.sum(independent**2), rel=1e-12)
    _, chi2 = reprojection(one_observation(False), T_WORLD_CAMERA[None], POINT_WORLD[None], CAMERA)
    assert chi2[0] == pytest.approx(chi2_of_offset(mono=False), rel=1e-9)
    _, chi2 = reprojection(one_observation(True), T_WORLD_CAMERA[None], POINT_WORLD[None], CAMERA)
    assert chi2[0] == pytest.approx(chi2_of_offset(mono=True), rel=1e-9)


def test_covariance_equals_that_of_simulated_measurements() -> None:
    noise = RNG.normal(size=(100_000, 3)) * SIGMAS_PX
    z = noisy(np.tile([300.0, 200.0, 280.0], (len(noise), 1)), noise)
    np.testing.assert_allclose(np.cov(z.T), COVARIANCE_PX2, atol=0.05)


@pytest.mark.parametrize("mono", [False, True])
def test_jacobians_equal_finite_differences_of_the_camera_model(mono: bool) -> None:
    """GTSAM's linear factor against central differences of Camera.project_stereo.

    Jacobian and error are compared through J^T J, J^T b and b^T b, which any square root of
    the information matrix gives alike.
    """
    maker = FactorMaker(CAMERA, SmootherConfig(robust=False))
    (factor,) = maker.observations(one_observation(mono))
    linear = factor.linearize(values_at(T_WORLD_CAMERA, POINT_WORLD))
    J, b = linear.jacobian()
    rows = slice(0, 2 if mono else 3)
    square_root = np.linalg.cholesky(np.linalg.inv(COVARIANCE_PX2[rows, rows])).T

    def whitened(T: np.ndarray, p: np.ndarray) -> np.ndarray:
        camera_point = transform(inverse(T), p[None])[0]
        r = CAMERA.project_stereo(camera_point) - one_observation(False).measurements[0]
        return square_root @ r[rows]

    h = 1e-6
    d_pose = [
        (
            whitened(T_WORLD_CAMERA @ se3_exp(h * e), POINT_WORLD)
            - whitened(T_WORLD_CAMERA @ se3_exp(-h * e), POINT_WORLD)
        )
        / (2 * h)
        for e in np.eye(6)
    ]
    d_point = [
        (
            whitened(T_WORLD_CAMERA, POINT_WORLD + h * e)
            - whitened(T_WORLD_CAMERA, POINT_WORLD - h * e)
        )
        / (2 * h)
        for e in np.eye(3)
    ]
    assert list(linear.keys()) == keyframe_keys(np.array([7])) + landmark_keys(np.array([9]))
    expected = np.column_stack([*d_pose, *d_point, -whitened(T_WORLD_CAMERA, POINT_WORLD)])
    from_gtsam = np.column_stack([J, b])
    np.testing.assert_allclose(
        from_gtsam.T @ from_gtsam, expected.T @ expected, rtol=1e-5, atol=1e-2
    )


def test_huber_starts_at_the_chi_square_bound() -> None:
    config = SmootherConfig(huber_stereo=2.0)
    z = one_observation(False)
    (factor,) = FactorMaker(CAMERA, config).observations(z)
    distance = np.sqrt(chi2_of_offset(mono=False))
    expected = 2.0 * (distance - 1.0)  # Huber's loss beyond k = 2
    assert distance > 2.0
    error = factor.error(values_at(T_WORLD_CAMERA, POINT_WORLD))
    assert error == pytest.approx(expected, rel=1e-9)


def test_relative_pose_is_T_a_b_with_the_covariance_at_b() -> None:
    T_world_a, T_a_b = T_WORLD_CAMERA, se3_exp(np.array([0.1, 0.2, -0.1, 0.5, 0.1, -0.4]))
    xi = np.array([0.001, -0.002, 0.003, 0.02, -0.01, 0.03])
    covariance = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    factor = FactorMaker(CAMERA, SmootherConfig()).pose_factor(
        RelativePose(1, 2, T_a_b, covariance)
    )
    T_world_b = T_world_a @ T_a_b @ se3_exp(xi)
    values = make_values(
        np.array([1, 2]), np.stack([T_world_a, T_world_b]), np.zeros(0, int), np.zeros((0, 3))
    )
    expected = 0.5 * xi @ np.linalg.solve(covariance, xi)
    assert factor.error(values) == pytest.approx(expected, rel=1e-6)


def test_prior_is_T_world_camera() -> None:
    xi = np.array([0.001, -0.002, 0.003, 0.02, -0.01, 0.03])
    covariance = np.diag([1e-6] * 3 + [1e-4] * 3)
    prior = PosePrior(7, T_WORLD_CAMERA, covariance)
    factor = FactorMaker(CAMERA, SmootherConfig()).pose_factor(prior)
    error = factor.error(values_at(T_WORLD_CAMERA @ se3_exp(xi), POINT_WORLD))
    assert error == pytest.approx(0.5 * xi @ np.linalg.solve(covariance, xi), rel=1e-6)


def test_factors_keep_the_order_of_mixed_observations() -> None:
    room = make_room(noise_px=1.0, mono_share=0.5)
    observations = room.observations
    factors = FactorMaker(CAMERA, SmootherConfig()).observations(observations)
    keys = [list(factor.keys()) for factor in factors]
    expected = zip(
        keyframe_keys(observations.keyframe_ids),
        landmark_keys(observations.landmark_ids),
        strict=True,
    )
    assert keys == [list(pair) for pair in expected]
    is_stereo = [isinstance(factor, gtsam.GenericStereoFactor3D) for factor in factors]
    assert is_stereo == np.isfinite(observations.measurements[:, 2]).tolist()
    assert make_graph(factors).size() == len(observations)


def test_values_are_returned_in_the_order_of_ids() -> None:
    keyframe_ids = np.array([2, 11, 100, 1000])
    landmark_ids = np.array([0, 5, 70, 10_000_000])
    poses, points = se3_exp(RNG.normal(size=(4, 6))), RNG.normal(size=(4, 3))
    shuffled = np.array([2, 0, 3, 1])
    values = make_values(
        keyframe_ids[shuffled], poses[shuffled], landmark_ids[shuffled], points[shuffled]
    )
    read_poses, read_points = read_values(values)
    np.testing.assert_allclose(read_poses, poses, atol=1e-12)
    np.testing.assert_array_equal(read_points, points)
    assert np.abs(se3_log(inverse(poses) @ read_poses)).max() < 1e-9


@pytest.mark.parametrize(
    ("text", "variable"),
    [
        ("near variable\n7782220156096217121 (Symbol: l33).", ("landmark", 33)),
        ('Attempting to at the key "x1", which does not exist', ("keyframe", 1)),
        ("something else", None),
    ],
)
def test_a_variable_is_read_from_the_text_of_an_error(
    text: str, variable: tuple[str, int] | None
) -> None:
    assert variable_named_in(text) == variable
