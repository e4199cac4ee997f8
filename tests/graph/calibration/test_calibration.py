"""Self-calibration on exact scenes: the result is the truth, and the uncertainty is consistent."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from calibration_scene import PRIORS, TRUTH, make_problem

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.calibration import _moved, calibrate
from bmask_slam.graph.calibration.covariance import _clustered_variance
from bmask_slam.graph.calibration.equations import normal_equations
from bmask_slam.graph.calibration.model import (
    BEND,
    FACTOR,
    OFFSET,
    PARAMETERS,
    SHUTTER,
    TIME,
    linearise,
    residuals_of,
)
from bmask_slam.graph.calibration.problem import (
    Anchors,
    CalibrationProblem,
    CalibrationState,
    anchor_terms,
)
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log

START = TRUTH + np.array(
    [15, -12, 6, -6, -0.05, 0.08, -0.001, 0.002, 0, 0.03, -0.012, -0.010, 0.005, *-TRUTH[13:]]
)
FREE_GAUGE = np.array([1.0] * 3 + [10.0] * 3)


def anchored(problem: CalibrationProblem, poses: Array, sigma_m: float) -> CalibrationProblem:
    """The problem with the true positions, disturbed by ``sigma_m``, without other constraints."""
    noise = sigma_m * np.random.default_rng(1).standard_normal((len(poses), 3))
    anchors = Anchors(poses[:, :3, 3] + noise, sigma_m)
    return dataclasses.replace(problem, anchors=anchors, pose_sigmas=FREE_GAUGE)


def test_model_fits_exact_views() -> None:
    problem, poses, points = make_problem()
    residuals = linearise(problem.views, poses, points, TRUTH).residuals
    assert len(residuals) > 500
    assert np.abs(residuals[:, :2]).max() < 1e-6
    assert np.abs(residuals[:, 2]).max() < 0.05  # second order in the 10 ms, a twentieth of sigma
    on_time = np.where(np.arange(18) == TIME, 0.0, TRUTH)
    assert np.abs(linearise(problem.views, poses, points, on_time).residuals[:, 2]).max() > 1


def test_derivatives_equal_finite_differences() -> None:
    problem, poses, points = make_problem(keyframes=4, points=40)
    views, h = problem.views, 1e-6
    calibration = TRUTH + 0.03 * PRIORS

    def residuals(xi: Array, shift: Array, change: Array) -> Array:
        moved = poses @ se3_exp(np.tile(xi, (len(poses), 1)))
        return linearise(views, moved, points + shift, calibration + change).residuals

    at = linearise(views, poses, points, calibration)
    for derivative, sizes in (
        ("pose", (6, 0, 0)),
        ("point", (0, 3, 0)),
        ("calibration", (0, 0, 18)),
    ):
        for i in range(sum(sizes)):
            step = h * (PRIORS[i] or 1.0) if derivative == "calibration" else h
            one = [
                np.eye(n)[i] * step if n else np.zeros(k)
                for n, k in zip(sizes, (6, 3, 18), strict=True)
            ]
            two = residuals(*one) - residuals(*(-x for x in one))
            got = getattr(at, derivative)[..., i]
            np.testing.assert_allclose(
                got, two / (2 * step), rtol=1e-4, atol=1e-3 * np.abs(got).max()
            )


def test_all_parameters_are_found_with_an_anchor() -> None:
    problem, poses, _ = make_problem(start=START)
    result = calibrate(anchored(problem, poses, 1e-4))
    assert result.converged
    error = np.abs(result.calibration - TRUTH)
    assert (error[:4] < 0.02).all(), error
    assert (error[4:9] < [3e-4, 6e-4, 2e-5, 2e-5, 1e-9]).all(), error
    assert error[FACTOR] < 3e-4 and error[OFFSET] < 3e-4 and error[TIME] < 1e-4
    assert (error[BEND] < 1e-4).all(), error


def test_a_rolling_shutter_is_found_with_its_sign() -> None:
    rolling = np.where(np.arange(18) == SHUTTER, 0.020, TRUTH)
    problem, poses, points = make_problem(truth=rolling, start=START)
    residuals = linearise(problem.views, poses, points, rolling).residuals
    assert np.abs(residuals).max() < 0.15  # of second order in the 10 ms from the middle
    assert np.abs(linearise(problem.views, poses, points, TRUTH).residuals).max() > 5
    result = calibrate(anchored(problem, poses, 1e-4))
    assert result.calibration[SHUTTER] == pytest.approx(0.020, abs=2e-4)
    assert (np.abs(result.calibration - rolling)[:4] < 0.1).all()
    global_shutter, poses, _ = make_problem(start=START)
    found = calibrate(anchored(global_shutter, poses, 1e-4)).calibration[SHUTTER]
    assert found == pytest.approx(0.0, abs=1e-4)


def test_without_an_anchor_only_the_scale_stays_at_its_prior() -> None:
    problem, _, _ = make_problem(start=START, noise=0.1)
    result = calibrate(problem)
    sigma = np.sqrt(np.diag(result.covariance))
    assert sigma[FACTOR] > 0.9 * PRIORS[FACTOR]
    others = (PRIORS > 0) & (np.arange(18) != FACTOR)
    assert (sigma[others] < 0.2 * PRIORS[others]).all()
    # A world 3 % too large, with its depths, fits as well: only offset / factor is told.
    assert result.calibration[FACTOR] == pytest.approx(START[FACTOR], abs=0.01)
    ratio, true_ratio = (
        result.calibration[OFFSET] / result.calibration[FACTOR],
        TRUTH[OFFSET] / TRUTH[FACTOR],
    )
    assert ratio == pytest.approx(true_ratio, abs=2e-3)
    assert np.abs(result.calibration - TRUTH)[:4].max() < 0.5


ARM_M = np.array([0.05, 0.16, -0.11])


def on_body(problem: CalibrationProblem, poses: Array, sigma_m: float) -> CalibrationProblem:
    """The problem anchored at a body's positions instead of the camera's."""
    body = poses.copy()
    body[:, :3, 3] += poses[:, :3, :3] @ ARM_M
    problem = anchored(problem, body, sigma_m)
    return dataclasses.replace(problem, anchors=dataclasses.replace(problem.anchors, on_body=True))


def test_an_anchor_on_another_body_gives_scale_and_lever_arm() -> None:
    problem, poses, _ = make_problem(start=START)
    problem = on_body(problem, poses, 1e-4)
    result = calibrate(problem)
    np.testing.assert_allclose(result.body_arm_m, ARM_M, atol=1e-3)
    assert result.anchor_rms_m < 2e-4
    assert result.calibration[FACTOR] == pytest.approx(TRUTH[FACTOR], abs=1e-3)
    as_camera_positions = dataclasses.replace(problem.anchors, on_body=False)
    wrong = calibrate(dataclasses.replace(problem, anchors=as_camera_positions))
    errors_px = [np.abs(r.calibration - TRUTH)[:4].max() for r in (result, wrong)]
    assert errors_px[0] < 0.1 and errors_px[1] > 2
    # Its place is one more unknown: the scale is told less surely than by the camera's positions.
    sigmas = [
        np.sqrt(
            calibrate(anchor(make_problem(start=START)[0], poses, 0.01)).covariance[FACTOR, FACTOR]
        )
        for anchor in (on_body, anchored)
    ]
    assert sigmas[0] > 1.05 * sigmas[1]


def test_a_step_that_turns_the_whole_world_changes_no_view() -> None:
    """Else far from the origin only small ones lower the cost, and the scale creeps."""
    problem, poses, _ = make_problem(start=START)
    problem = on_body(problem, poses, 0.01)
    before = CalibrationState(poses, problem.points_world, problem.calibration)
    turn = np.array([0.1, -0.2, 0.15, 1.0, 2.0, -1.0])
    steps = se3_log(inverse(poses) @ se3_exp(turn) @ poses)
    points = np.cross(turn[:3], before.points) + turn[3:]
    after = _moved(problem, before, steps, points, np.zeros(len(PARAMETERS)))
    assert np.linalg.norm(after.points - before.points, axis=1).min() > 0.5
    residuals = (residuals_of(problem.views, *state.values) for state in (before, after))
    np.testing.assert_allclose(*residuals, atol=1e-6)


def test_derivatives_of_body_positions_at_the_best_lever_arm() -> None:
    problem, poses, points = make_problem(keyframes=5, points=40)
    problem, h = on_body(problem, poses, 0.01), 1e-6
    start = poses @ se3_exp(0.02 * np.random.default_rng(3).standard_normal((5, 6)))

    def terms(xi: Array) -> tuple[Array, Array]:
        state = CalibrationState(start @ se3_exp(xi.reshape(5, 6)), points, TRUTH)
        return anchor_terms(problem, state)

    r, J = terms(np.zeros(30))
    steps = h * np.eye(30)
    costs = [[0.5 * float(terms(x)[0] @ terms(x)[0]) for x in (-step, step)] for step in steps]
    np.testing.assert_allclose(J.T @ r, np.diff(costs)[:, 0] / (2 * h), rtol=1e-4, atol=1e-3)


def test_one_known_distance_is_an_anchor() -> None:
    problem, poses, _ = make_problem(start=START)
    arms = np.array([[[0.02, 0.01, 0.03], [-0.01, 0.0, 0.05]]])
    ends = np.einsum("eij,ej->ei", poses[[1, 9], :3, :3], arms[0]) + poses[[1, 9], :3, 3]
    distance = np.linalg.norm(ends[1] - ends[0])
    anchors = Anchors(
        np.full((len(poses), 3), np.nan),
        ends=np.array([[1, 9]]),
        arms_m=arms,
        distances_m=np.array([distance]),
        distance_sigma_m=1e-3,
    )
    result = calibrate(dataclasses.replace(problem, anchors=anchors))
    assert result.calibration[FACTOR] == pytest.approx(TRUTH[FACTOR], abs=1e-3)
    assert np.sqrt(result.covariance[FACTOR, FACTOR]) == pytest.approx(
        TRUTH[FACTOR] * 1e-3 / distance, rel=0.3
    )


def test_fixed_parameters_do_not_change() -> None:
    fixed = [PARAMETERS.index(name) for name in ("k1", "k2", "time_offset_s")]
    problem, _, _ = make_problem(start=START, noise=0.1)
    sigmas = PRIORS.copy()
    sigmas[fixed] = 0.0
    result = calibrate(dataclasses.replace(problem, prior_sigmas=sigmas))
    np.testing.assert_array_equal(result.calibration[fixed], START[fixed])
    assert not result.covariance[fixed].any() and not result.covariance[:, fixed].any()


def test_twenty_percent_wrong_matches_have_little_effect() -> None:
    problem, _, _ = make_problem(start=START, noise=0.5)
    views, rng = problem.views, np.random.default_rng(5)
    wrong = rng.random(len(views.pixels)) < 0.2
    pixels = views.pixels + wrong[:, None] * rng.uniform(-40, 40, views.pixels.shape)
    result = calibrate(
        dataclasses.replace(problem, views=dataclasses.replace(views, pixels=pixels))
    )
    sigma = np.sqrt(np.diag(result.covariance))
    assert (np.abs(result.calibration - TRUTH)[:4] < 4 * sigma[:4]).all()
    assert sigma[:4].max() < 0.6


def test_sigmas_agree_with_the_errors() -> None:
    """NEES over noisy scenes: normalised errors of every parameter have about unit variance."""
    z, nees = [], []
    free = np.flatnonzero(PRIORS > 0)
    for seed in range(10):
        problem, poses, _ = make_problem(seed=seed, noise=1.0, keyframes=10, points=90)
        rng = np.random.default_rng(100 + seed)
        start = TRUTH + PRIORS * rng.standard_normal(18)
        problem = dataclasses.replace(anchored(problem, poses, 0.01), calibration=start)
        result = calibrate(problem)
        error = (result.calibration - TRUTH)[free]
        covariance = result.covariance[np.ix_(free, free)]
        z.append(error / np.sqrt(np.diag(covariance)))
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 0.55 < np.sqrt(np.mean(np.square(z))) < 1.2
    assert np.abs(z).max() < 4
    assert 0.5 * len(free) < np.mean(nees) < 1.5 * len(free)


def test_errors_correlated_along_the_path_widen_the_bounds() -> None:
    """Each pair of keyframes sees the images a little too large or too small."""

    def ratio(spread: float) -> Array:
        """Stated sigmas of the focal lengths over those of independent errors, (2,)."""
        problem, poses, _ = make_problem(seed=1, noise=0.3, keyframes=16, points=80)
        views, rng = problem.views, np.random.default_rng(1)
        larger = 1 + spread * rng.standard_normal(8)[views.keyframes // 2]
        pixels = TRUTH[2:4] + larger[:, None] * (views.pixels - TRUTH[2:4])
        problem = dataclasses.replace(problem, views=dataclasses.replace(views, pixels=pixels))
        problem = anchored(problem, poses, 0.01)
        result = calibrate(problem)
        state = CalibrationState(result.poses_world_camera, result.points_world, result.calibration)
        S = normal_equations(problem, state, result.noise_scales, 0.0).S
        independent = np.sqrt(np.diag(np.linalg.inv(S))[-18:-16])
        return np.sqrt(np.diag(result.covariance)[:2]) / independent

    assert (ratio(0.0) < 1.5).all()
    assert (ratio(0.004) > 1.7).all()


def test_clustered_variances_are_sums_of_squares_raised_to_students_bound() -> None:
    scores = np.random.default_rng(0).standard_normal((40, 18))
    clusters = np.repeat(np.arange(5), 8)
    total = sum(scores[clusters == c].sum(axis=0) ** 2 for c in range(5))
    bound = 2.776445 / 1.959964  # Student's t, 4 degrees of freedom
    np.testing.assert_allclose(
        _clustered_variance(scores, clusters), total * 5 / 4 * bound**2, rtol=1e-5
    )
