"""Self-calibration: bundle adjustment of poses, landmarks and the camera's calibration.

Landmarks are eliminated (Schur complement), poses and calibration solved together by
Levenberg-Marquardt. Cauchy's kernel keeps wrong matches out; the noise of pixels and depths is
estimated along with the rest, since the sigmas that a run works with are only nominal, and the
covariance is stated in that estimated noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.sparse import bsr_array

from graph.calibration_model import CalibrationViews, linearise
from graph.calibration_problem import (
    CalibrationProblem,
    CalibrationState,
    N,
    add_priors,
    anchor_rms,
    anchor_terms,
    prior_information,
    prior_residuals,
)
from graph.geometry import Array, se3_exp

CAUCHY = 2.385  # 95 % efficiency on Gaussian noise
MIN_NOISE_SCALE = 0.02
MEDIAN_CHI2_1DOF, MEDIAN_CHI2_2DOF = 0.455, 1.386
MIN_LEFT = 0.1


@dataclass(frozen=True)
class CalibrationConfig:
    """How the solver goes about it: rounds of noise estimation, steps a round, and when to end."""

    rounds: int = 10
    steps: int = 15
    tolerance: float = 1e-6
    max_damping: float = 1e6


@dataclass(frozen=True)
class CalibrationResult:
    """Where the solver ended.

    Attributes:
        calibration: (12,), and its covariance (12, 12), zero in fixed parameters.
        poses_world_camera: (K, 4, 4); points_world: (L, 3).
        noise_scales: (2,) how many times the nominal sigmas of pixels and of depths the
            residuals are.
        anchor_rms_m: RMS of what anchors and result differ by, NaN without any.
        inlier_share: of the views' measurements within 3 of those sigmas.
        converged: whether the last step was negligible.
    """

    calibration: Array
    covariance: Array
    poses_world_camera: Array
    points_world: Array
    noise_scales: Array
    anchor_rms_m: float
    inlier_share: float
    converged: bool


@dataclass(frozen=True)
class _Reduced:
    """Normal equations of poses and calibration, with what is needed to find the points again."""

    S: Array
    b: Array
    landmark_inverse: Array
    landmark_gradient: Array
    cross_pose: Array
    cross_calibration: Array


def calibrate(
    problem: CalibrationProblem, config: CalibrationConfig | None = None
) -> CalibrationResult:
    """The most probable poses, points and calibration, and the covariance of the last."""
    config = config or CalibrationConfig()
    state = CalibrationState(problem.poses_world_camera, problem.points_world, problem.calibration)
    scales = np.ones(2)
    for _ in range(config.rounds):
        before = state
        scales = _noise_scales(problem, state, scales)
        state = _descend(problem, state, scales, config)
        change = (state.calibration - before.calibration) / np.maximum(problem.prior_sigmas, 1e-12)
        converged = bool(np.abs(change).max() < 1e-3)
        if converged:
            break
    covariance = _covariance(problem, state, scales)
    lin = linearise(problem.views, *_values(state))
    e2 = _squared(lin.residuals, scales)
    return CalibrationResult(
        calibration=state.calibration,
        covariance=covariance,
        poses_world_camera=state.poses,
        points_world=state.points,
        noise_scales=scales,
        anchor_rms_m=anchor_rms(problem, state),
        inlier_share=float((e2[lin.valid[:, 1:]] < 9).mean()),
        converged=converged,
    )


def _values(state: CalibrationState) -> tuple[Array, Array, Array]:
    return state.poses, state.points, state.calibration


def _descend(
    problem: CalibrationProblem, state: CalibrationState, scales: Array, config: CalibrationConfig
) -> CalibrationState:
    """Levenberg-Marquardt at this noise; steps that raise the cost are taken back."""
    damping, cost = 1e-6, _cost(problem, state, scales)
    for _ in range(config.steps):
        step = _step(problem, state, scales, damping)
        while True:
            moved = _moved(state, *step) if step else state
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
    """Step of poses (K, 6), points (L, 3) and calibration (12,); None: not positive definite."""
    reduced = _normal_equations(problem, state, scales, damping)
    try:
        x = -cho_solve(cho_factor(reduced.S), reduced.b)
    except LinAlgError:
        return None
    poses, points, calibration = _with_points(problem.views, reduced, x[:, None])
    points -= reduced.landmark_inverse @ reduced.landmark_gradient[..., None]
    return poses[..., 0], points[..., 0], calibration[:, 0]


def _with_points(
    views: CalibrationViews, reduced: _Reduced, x: Array
) -> tuple[Array, Array, Array]:
    """Columns (6K + 12, n) of poses and calibration with what they make of the points.

    Returns (K, 6, n), (L, 3, n) and (12, n).
    """
    poses, calibration = x[:-N].reshape(-1, 6, x.shape[1]), x[-N:]
    right = reduced.cross_calibration.swapaxes(1, 2) @ calibration
    from_poses = reduced.cross_pose.swapaxes(1, 2) @ poses[views.keyframes]
    np.add.at(right, views.landmarks, from_poses)
    return poses, -reduced.landmark_inverse @ right, calibration


def _covariance(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> Array:
    """Covariance (12, 12) of the calibration, zero in what is held fixed.

    Two are made: the inverse of the normal equations, right if errors are independent, and the
    sandwich with all errors of a landmark in one cluster, right too if those depend on each other
    (a landmark's patch looks different, in the same way, from neighbouring views). The correlations
    are those of the first, the standard deviations the larger of the two.
    """
    views = problem.views
    reduced = _normal_equations(problem, state, scales, 0.0)
    unit = 1 / np.sqrt(np.diag(reduced.S))
    correlation = np.linalg.inv(reduced.S * np.outer(unit, unit)).astype(float)
    by_rhs: Array = (correlation * np.outer(unit, unit))[:, -N:]
    poses, points, calibration = _with_points(views, reduced, by_rhs)
    lin = linearise(views, *_values(state))
    influence = (
        lin.pose @ poses[views.keyframes]
        + lin.point @ points[views.landmarks]
        + lin.calibration @ calibration
    )
    weight = (_root_weights(lin.residuals, scales) ** 2)[..., 0]
    scores = np.zeros((len(state.points), N))
    np.add.at(scores, views.landmarks, np.einsum("mri,mr->mi", influence, weight * lin.residuals))
    prior = prior_information(problem, state)
    model = calibration
    clustered = scores.T @ scores + by_rhs.T @ prior @ by_rhs
    sigma = np.sqrt(np.diag(model))
    larger = np.sqrt(np.maximum(np.diag(clustered), np.diag(model))) / sigma
    free = problem.prior_sigmas > 0
    return np.where(np.outer(free, free), model * np.outer(larger, larger), 0.0)


def _moved(
    state: CalibrationState, poses: Array, points: Array, calibration: Array
) -> CalibrationState:
    return CalibrationState(
        state.poses @ se3_exp(poses), state.points + points, state.calibration + calibration
    )


def _squared(residuals: Array, scales: Array) -> Array:
    """Squared errors (M, 2) of pixel and depth in units of the estimated noise."""
    pixel = (residuals[:, :2] ** 2).sum(axis=1) / scales[0] ** 2
    return np.stack([pixel, residuals[:, 2] ** 2 / scales[1] ** 2], axis=1)


def _root_weights(residuals: Array, scales: Array) -> Array:
    """Roots (M, 3, 1) of Cauchy's weights over the estimated noise."""
    root = np.sqrt(1 / (1 + _squared(residuals, scales) / CAUCHY**2)) / scales
    return root[:, [0, 0, 1], None]


def _cost(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> float:
    e2 = _squared(linearise(problem.views, *_values(state)).residuals, scales)
    cost = 0.5 * CAUCHY**2 * np.log1p(e2 / CAUCHY**2).sum()
    pose, calibration = prior_residuals(problem, state)
    anchors, _ = anchor_terms(problem, state)
    return float(cost + 0.5 * (pose @ pose + calibration @ calibration + anchors @ anchors))


def _normal_equations(
    problem: CalibrationProblem, state: CalibrationState, scales: Array, damping: float
) -> _Reduced:
    """Schur complement of the weighted normal equations on poses (first) and calibration."""
    views, K, L = problem.views, len(state.poses), len(state.points)
    lin = linearise(views, *_values(state))
    root = _root_weights(lin.residuals, scales)
    r, J_c, J_l, J_k = (
        lin.residuals * root[..., 0], lin.pose * root, lin.point * root, lin.calibration * root,
    )  # fmt: skip
    H_ll, g_l = np.zeros((L, 3, 3)), np.zeros((L, 3))
    np.add.at(H_ll, views.landmarks, J_l.swapaxes(1, 2) @ J_l)
    np.add.at(g_l, views.landmarks, np.einsum("mri,mr->mi", J_l, r))
    H_ll = _damped(H_ll, damping) + 1e-9 * np.eye(3)
    inverse_ll: Array = np.linalg.inv(H_ll).astype(float)
    cross_c, cross_k = J_c.swapaxes(1, 2) @ J_l, np.zeros((L, N, 3))
    np.add.at(cross_k, views.landmarks, J_k.swapaxes(1, 2) @ J_l)

    H_c, g_c, H_ck = np.zeros((K, 6, 6)), np.zeros((K, 6)), np.zeros((K, 6, N))
    shrunk = cross_c @ inverse_ll[views.landmarks]
    np.add.at(H_c, views.keyframes, J_c.swapaxes(1, 2) @ J_c)
    np.add.at(g_c, views.keyframes, np.einsum("mri,mr->mi", J_c, r))
    S_ck = J_c.swapaxes(1, 2) @ J_k - shrunk @ cross_k[views.landmarks].swapaxes(1, 2)
    np.add.at(H_ck, views.keyframes, S_ck)
    b_c = g_c.copy()
    np.add.at(b_c, views.keyframes, -np.einsum("mij,mj->mi", shrunk, g_l[views.landmarks]))
    shrunk_k = cross_k @ inverse_ll
    H_k = _damped(np.einsum("mri,mrj->ij", J_k, J_k), damping)
    S: Array = np.zeros((6 * K + N, 6 * K + N))
    S[:-N, :-N] = _block_diagonal(_damped(H_c, damping)) - _product(views, shrunk, cross_c, K, L)
    S[:-N, -N:] = H_ck.reshape(6 * K, N)
    S[-N:, :-N] = S[:-N, -N:].T
    S[-N:, -N:] = H_k - np.einsum("lik,ljk->ij", shrunk_k, cross_k)
    b_k = np.einsum("mri,mr->i", J_k, r) - np.einsum("lij,lj->i", shrunk_k, g_l)
    b = np.concatenate([b_c.ravel(), b_k])
    add_priors(problem, state, S, b)
    return _Reduced(S, b, inverse_ll, g_l, cross_c, cross_k)


def _damped(H: Array, damping: float) -> Array:
    return H + damping * H * np.eye(H.shape[-1])


def _block_diagonal(blocks: Array) -> Array:
    count, size = blocks.shape[:2]
    whole = np.zeros((count, size, count, size))
    whole[np.arange(count), :, np.arange(count), :] = blocks
    return whole.reshape(count * size, count * size)


def _product(views: CalibrationViews, left: Array, right: Array, K: int, L: int) -> Array:
    """Dense (6K, 6K) product of two sparse matrices with a (6, 3) block for each view."""
    order = np.lexsort((views.landmarks, views.keyframes))
    columns = views.landmarks[order]
    starts = np.searchsorted(views.keyframes[order], np.arange(K + 1))
    a, b = (bsr_array((m[order], columns, starts), shape=(6 * K, 3 * L)) for m in (left, right))
    return np.asarray((a @ b.T).todense())


def _noise_scales(problem: CalibrationProblem, state: CalibrationState, scales: Array) -> Array:
    """How many times the nominal sigmas of pixels and depths the noise is, (2,).

    From medians, which wrong matches do not move, of residuals over the root of what the landmark
    left of them: 1 - h, with h the diagonal of its hat matrix J (J^T J)^-1 J^T.
    """
    views = problem.views
    lin = linearise(views, *_values(state))
    J = lin.point / scales[[0, 0, 1], None]
    H = np.zeros((len(state.points), 3, 3)) + 1e-9 * np.eye(3)
    np.add.at(H, views.landmarks, J.swapaxes(1, 2) @ J)
    left = 1 - np.einsum("mri,mij,mrj->mr", J, np.linalg.inv(H)[views.landmarks], J)
    chi2 = lin.residuals**2 / np.maximum(left, MIN_LEFT)
    told = lin.valid & (left > MIN_LEFT)
    pixel, depth = told[:, 0] & told[:, 1], told[:, 2]
    medians = [
        np.median(chi2[pixel, :2].sum(axis=1)) / MEDIAN_CHI2_2DOF if pixel.any() else 1.0,
        np.median(chi2[depth, 2]) / MEDIAN_CHI2_1DOF if depth.any() else 1.0,
    ]
    return np.maximum(np.sqrt(medians), MIN_NOISE_SCALE)
