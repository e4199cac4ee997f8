"""Self-calibration: bundle adjustment of poses, landmarks and the camera's calibration.

Landmarks are eliminated (Schur complement), poses and calibration solved together by
Levenberg-Marquardt. Cauchy's kernel suppresses wrong matches; the noise of pixels and depths is
estimated too, since the sigmas of a run are only nominal, and the covariance refers to the
estimated noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.calibration.covariance import covariance_of
from bmask_slam.graph.calibration.equations import (
    CAUCHY,
    inverse_information,
    normal_equations,
    squared,
    with_points,
)
from bmask_slam.graph.calibration.model import linearise, residuals_of
from bmask_slam.graph.calibration.problem import (
    CalibrationProblem,
    CalibrationState,
    anchor_rms,
    anchor_terms,
    body_arm,
    prior_residuals,
    transform_each,
)
from bmask_slam.graph.geometry import inverse, se3_exp

MIN_NOISE_SCALE = 0.02
MEDIAN_CHI2_1DOF, MEDIAN_CHI2_2DOF = 0.455, 1.386
MIN_LEFT = 0.1


@dataclass(frozen=True)
class CalibrationConfig:
    """Rounds of noise estimation, steps a round, and when the solver ends."""

    rounds: int = 10
    steps: int = 15
    tolerance: float = 1e-6
    max_damping: float = 1e6


@dataclass(frozen=True)
class CalibrationResult:
    """The result of the solver.

    Attributes:
        calibration: (18,), and its covariance (18, 18), zero in fixed parameters.
        poses_world_camera: (K, 4, 4); points_world: (L, 3).
        noise_scales: (2,) ratio of the residuals to the nominal sigmas of pixels and of depths.
        body_arm_m: (3,) position in the camera's frame of the body that the anchors refer to.
        anchor_rms_m: RMS difference of anchors and result, NaN without anchors.
        inlier_share: of the views' measurements within 3 of those sigmas.
        converged: whether the last step was negligible.
    """

    calibration: Array
    covariance: Array
    poses_world_camera: Array
    points_world: Array
    noise_scales: Array
    body_arm_m: Array
    anchor_rms_m: float
    inlier_share: float
    converged: bool


def calibrate(
    problem: CalibrationProblem,
    config: CalibrationConfig | None = None,
    noise_scales: Array | None = None,
) -> CalibrationResult:
    """The most probable poses, points and calibration, and the covariance of the last.

    With ``noise_scales`` (2,) the noise is held, which makes costs comparable.
    """
    config = config or CalibrationConfig()
    state = CalibrationState(problem.poses_world_camera, problem.points_world, problem.calibration)
    scales = np.ones(2) if noise_scales is None else noise_scales
    for _ in range(config.rounds):
        before = state
        if noise_scales is None:
            scales = _noise_scales(problem, state, scales)
        state = _descend(problem, state, scales, config)
        change = (state.calibration - before.calibration) / np.maximum(problem.prior_sigmas, 1e-12)
        converged = bool(np.abs(change).max() < 1e-3)
        if converged:
            break
    covariance = covariance_of(problem, state, scales)
    lin = linearise(problem.views, *state.values)
    e2 = squared(lin.residuals, scales)
    return CalibrationResult(
        calibration=state.calibration,
        covariance=covariance,
        poses_world_camera=state.poses,
        points_world=state.points,
        noise_scales=scales,
        body_arm_m=body_arm(problem.anchors, state.poses) if problem.anchors else np.zeros(3),
        anchor_rms_m=anchor_rms(problem, state),
        inlier_share=float((e2[lin.valid[:, 1:]] < 9).mean()),
        converged=converged,
    )


def _descend(
    problem: CalibrationProblem, state: CalibrationState, scales: Array, config: CalibrationConfig
) -> CalibrationState:
    """Levenberg-Marquardt with this noise; steps that increase the cost are rejected."""
    damping, cost = 1e-6, _cost(problem, state, scales)
    for _ in range(config.steps):
        step = _step(problem, state, scales, damping)
        while True:
            moved = _moved(problem, state, *step) if step else state
            new_cost = _cost(problem, moved, scales)
            if step and new_cost <= cost:
                break
            damping = max(10 * damping, 1e-6)
            if damping > config.max_damping:
                return state
            step = _step(problem, state, scales, damping)
        drop, cost, state, damping = cost - new_cost, new_cost, moved, damping / 10
        if drop <= config.tolerance * cost:
            break
    return state


def _step(
    problem: CalibrationProblem, state: CalibrationState, scales: Array, damping: float
) -> tuple[Array, Array, Array] | None:
    """Step of poses (K, 6), points (L, 3) and calibration (18,); None: not positive definite."""
    reduced = normal_equations(problem, state, scales, damping)
    try:
        x = -cho_solve(cho_factor(reduced.S), reduced.b)
    except LinAlgError:
        return None
    poses, points, calibration = with_points(problem.views, reduced, x[:, None])
    points -= reduced.landmark_inverse @ reduced.landmark_gradient[..., None]
    return poses[..., 0], points[..., 0], calibration[:, 0]


def _moved(
    problem: CalibrationProblem,
    state: CalibrationState,
    poses: Array,
    points: Array,
    calibration: Array,
) -> CalibrationState:
    """The state after a step, exact where it turns the world, which only anchors hold.

    With them a point moves with the keyframe that sees it first, and its own step is what is left.
    """
    moved = state.poses @ se3_exp(poses)
    if problem.anchors is None:
        return CalibrationState(moved, state.points + points, state.calibration + calibration)
    landmarks, first = np.unique(problem.views.landmarks, return_index=True)
    k = np.zeros(len(state.points), np.int64)
    k[landmarks] = problem.views.keyframes[first]
    seen = transform_each(inverse(state.poses[k]), state.points)
    own = (points[:, None] @ state.poses[k, :3, :3])[:, 0]
    own -= np.cross(poses[k, :3], seen) + poses[k, 3:]
    return CalibrationState(
        moved, transform_each(moved[k], seen + own), state.calibration + calibration
    )


def _cost(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> float:
    e2 = squared(residuals_of(problem.views, *state.values), scales)
    cost = 0.5 * CAUCHY**2 * np.log1p(e2 / CAUCHY**2).sum()
    pose, calibration = prior_residuals(problem, state)
    anchors, _ = anchor_terms(problem, state)
    return float(cost + 0.5 * (pose @ pose + calibration @ calibration + anchors @ anchors))


def _noise_scales(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> Array:
    """Ratio (2,) of the noise to the nominal sigmas of pixels and depths.

    From medians, which wrong matches do not affect, of squared residuals over 1 - h, with h the
    diagonal of the landmark's hat matrix J (J^T J)^-1 J^T: the share that its estimation leaves.
    """
    views = problem.views
    lin = linearise(views, *state.values)
    J = lin.point / scales[[0, 0, 1], None]
    H = np.zeros((len(state.points), 3, 3))
    np.add.at(H, views.landmarks, J.swapaxes(1, 2) @ J)
    left = 1 - np.einsum("mri,mij,mrj->mr", J, inverse_information(H)[views.landmarks], J)
    chi2 = lin.residuals**2 / np.maximum(left, MIN_LEFT)
    told = lin.valid & (left > MIN_LEFT)
    pixel, depth = told[:, 0] & told[:, 1], told[:, 2]
    medians = [
        np.median(chi2[pixel, :2].sum(axis=1)) / MEDIAN_CHI2_2DOF if pixel.any() else 1.0,
        np.median(chi2[depth, 2]) / MEDIAN_CHI2_1DOF if depth.any() else 1.0,
    ]
    return np.maximum(np.sqrt(medians), MIN_NOISE_SCALE)
