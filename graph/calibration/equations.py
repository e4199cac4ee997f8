"""Normal equations of self-calibration, with the landmarks eliminated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.batch.group_sums import GroupSums
from bmask_slam.graph.calibration.model import CalibrationViews, linearise
from bmask_slam.graph.calibration.problem import CalibrationProblem, CalibrationState, N, add_priors

CAUCHY = 2.385  # 95 % efficiency on Gaussian noise


@dataclass(frozen=True)
class Reduced:
    """Normal equations of poses and calibration, with what is needed to recover the points.

    ``cross_calibration`` (L, f, 3) is of the ``free`` (f,) parameters alone, by their places.
    """

    S: Array
    b: Array
    landmark_inverse: Array
    landmark_gradient: Array
    cross_pose: Array
    cross_calibration: Array
    free: Ints


def normal_equations(
    problem: CalibrationProblem, state: CalibrationState, scales: Array, damping: float
) -> Reduced:
    """Schur complement of the weighted normal equations on poses (first) and calibration."""
    views, K, L = problem.views, len(state.poses), len(state.points)
    lin, free = linearise(views, *state.values), np.flatnonzero(problem.prior_sigmas > 0)
    root = root_weights(lin.residuals, scales)
    r, J_c, J_l = lin.residuals * root[..., 0], lin.pose * root, lin.point * root
    J_k = lin.calibration[..., free] * root
    of_landmarks, of_keyframes = GroupSums(views.landmarks, L), GroupSums(views.keyframes, K)
    H_ll = of_landmarks(J_l.swapaxes(1, 2) @ J_l)
    g_l = of_landmarks(np.einsum("mri,mr->mi", J_l, r))
    inverse_ll = inverse_information(_damped(H_ll, damping))
    cross_c, cross_k = J_c.swapaxes(1, 2) @ J_l, of_landmarks(J_k.swapaxes(1, 2) @ J_l)

    shrunk = cross_c @ inverse_ll[views.landmarks]
    H_c = of_keyframes(J_c.swapaxes(1, 2) @ J_c)
    S_ck = J_c.swapaxes(1, 2) @ J_k - shrunk @ cross_k[views.landmarks].swapaxes(1, 2)
    H_ck = of_keyframes(S_ck)
    known = np.einsum("mij,mj->mi", shrunk, g_l[views.landmarks])
    b_c = of_keyframes(np.einsum("mri,mr->mi", J_c, r) - known)
    shrunk_k = cross_k @ inverse_ll
    flat = J_k.reshape(3 * len(r), len(free))
    H_k = _damped(flat.T @ flat, damping)
    S, b = np.zeros((6 * K + N, 6 * K + N)), np.zeros(6 * K + N)
    S[:-N, :-N] = _block_diagonal(_damped(H_c, damping)) - _product(views, shrunk, cross_c, K, L)
    at = 6 * K + free
    S[:-N, at] = H_ck.reshape(6 * K, len(free))
    S[at, :-N] = S[:-N, at].T
    S[np.ix_(at, at)] = H_k - np.einsum("lik,ljk->ij", shrunk_k, cross_k)
    b[:-N] = b_c.ravel()
    b[at] = flat.T @ r.ravel() - np.einsum("lij,lj->i", shrunk_k, g_l)
    add_priors(problem, state, S, b)
    return Reduced(S, b, inverse_ll, g_l, cross_c, cross_k, free)


def inverse_information(H: Array) -> Array:
    """Inverses of the information (L, 3, 3) of landmarks, of which some are hardly determined.

    A landmark without depth that is always seen in the same direction has none along it.
    """
    scale = np.trace(H, axis1=1, axis2=2)[:, None, None]
    inverse: Array = np.linalg.inv(H + (1e-9 + 1e-13 * scale) * np.eye(3)).astype(float)
    return inverse


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


def with_points(views: CalibrationViews, reduced: Reduced, x: Array) -> tuple[Array, Array, Array]:
    """Columns (6K + 18, n) of poses and calibration, and the points that follow from them.

    Returns (K, 6, n), (L, 3, n) and (18, n).
    """
    poses, calibration = x[:-N].reshape(-1, 6, x.shape[1]), x[-N:]
    right = reduced.cross_calibration.swapaxes(1, 2) @ calibration[reduced.free]
    from_poses = reduced.cross_pose.swapaxes(1, 2) @ poses[views.keyframes]
    np.add.at(right, views.landmarks, from_poses)
    return poses, -reduced.landmark_inverse @ right, calibration


def squared(residuals: Array, scales: Array) -> Array:
    """Squared errors (M, 2) of pixel and depth in units of the estimated noise."""
    pixel = (residuals[:, :2] ** 2).sum(axis=1) / scales[0] ** 2
    return np.stack([pixel, residuals[:, 2] ** 2 / scales[1] ** 2], axis=1)


def root_weights(residuals: Array, scales: Array) -> Array:
    """Roots (M, 3, 1) of Cauchy's weights over the estimated noise."""
    root = np.sqrt(1 / (1 + squared(residuals, scales) / CAUCHY**2)) / scales
    return root[:, [0, 0, 1], None]
