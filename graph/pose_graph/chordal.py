"""The chordal initial value of a pose graph: rotations first, then positions, both linear."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.geometry import make_pose
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, complex_rotations, planar_poses

LEAST_WEIGHT = 1e-6  # of the median: a graph stays connected by edges of almost no information
_SYMMETRIC = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}


def chordal_poses(graph: PoseGraph) -> Array:
    """Poses (N, 4, 4) of a connected graph by chordal relaxation; fixed vertices keep theirs.

    Martinec and Pajdla, CVPR 2007; Carlone et al., ICRA 2015: rotations minimise
    ``sum kappa |R_j - R_i R_ij|^2`` over all matrices, each is moved to the nearest rotation, and
    positions minimise ``sum tau |p_j - p_i - R_i t_ij|^2``. kappa and tau are the mean information
    of an edge's rotation and translation. GTSAM's InitializePose3 has no such weights and solves
    for nine unknowns a pose together, where the three rows of a rotation have the same equations:
    it takes five times as long and starts at up to a thousand times the cost.
    """
    if graph.is_planar:
        return poses_of_rotations(graph, _planar_rotations(graph))
    weights = mean_information(graph.information[:, :3, :3])
    R_ij, given, known = graph.measurements[:, :3, :3], graph.poses[:, :3, :3], _known(graph)
    transposed = _solve(graph, weights, np.swapaxes(R_ij, 1, 2), np.swapaxes(given, 1, 2))
    R = _nearest_rotations(np.swapaxes(transposed, 1, 2))
    R[known] = given[known]
    return poses_of_rotations(graph, R)


def _planar_rotations(graph: PoseGraph) -> Array:
    """(N, 2, 2): in the plane a rotation is a complex number of length 1, so is its relaxation."""
    weights = mean_information(graph.information[:, 2:, 2:])
    given, links = complex_rotations(graph.poses), complex_rotations(graph.measurements)
    z = _solve(graph, weights, links[:, None, None], given[:, None, None])[:, 0, 0]
    return planar_poses(np.angle(z)[:, None] * [0.0, 0.0, 1.0])[:, :2, :2]


def poses_of_rotations(graph: PoseGraph, R: Array) -> Array:
    """Poses (N, 4, 4) with these rotations (N, d, d), d = 2 or 3, and the positions they lead to.

    The positions minimise ``sum tau |p_j - p_i - R_i t_ij|^2``; fixed vertices keep theirs.
    """
    (i, j), (n, d) = graph.edges.T, R.shape[:2]
    step = slice(0, 2) if d == 2 else slice(3, 6)
    weights = mean_information(graph.information[:, step, step])
    pulls = np.zeros((n, 1, d))
    steps = weights[:, None, None] * (R[i] @ graph.measurements[:, :d, 3:]).reshape(-1, 1, d)
    np.add.at(pulls, j, steps)
    np.add.at(pulls, i, -steps)
    T = make_pose(np.eye(3), graph.poses[:, :3, 3])
    T[:, :d, :d] = R
    ones = np.ones((len(i), 1, 1))
    T[:, :d, 3] = _solve(graph, weights, ones, T[:, None, :d, 3], pulls)[:, 0]
    return T


def _known(graph: PoseGraph) -> Mask:
    """(N,) the fixed vertices, or the first."""
    return graph.fixed if graph.fixed.any() else np.arange(len(graph.ids)) == 0


def mean_information(information: Array) -> Array:
    """Mean information (M,) of blocks (M, k, k), relative to the median edge."""
    mean = np.trace(information, axis1=1, axis2=2)
    return np.maximum(mean / np.median(mean), LEAST_WEIGHT)


def _solve(
    graph: PoseGraph, weights: Array, links: Any, given: Any, pulls: Array | None = None
) -> Any:
    """X (N, k, c) minimising ``sum w |X_j - B X_i|^2 - 2 pulls X`` for unitary B (M, k, k).

    Fixed vertices keep what is given (N, k, c).
    """
    (i, j), (n, k) = graph.edges.T, given.shape[:2]
    span, diagonal = np.arange(k), np.arange(n * k)
    entries = (-weights[:, None, None] * links).ravel()
    rows = (j[:, None, None] * k + span[:, None] + 0 * span).ravel()
    columns = (i[:, None, None] * k + 0 * span[:, None] + span).ravel()
    degrees = np.bincount(i, weights, n) + np.bincount(j, weights, n)
    entries = np.concatenate([entries, entries.conj(), np.repeat(degrees, k)])
    rows, columns = np.r_[rows, columns, diagonal], np.r_[columns, rows, diagonal]
    free, X = np.repeat(~_known(graph), k), given.reshape(n * k, -1).copy()
    if not free.any():
        return X.reshape(given.shape)
    right = np.zeros(X.shape, X.dtype) if pulls is None else pulls.reshape(X.shape).copy()
    at_known = ~free[columns]
    np.subtract.at(right, rows[at_known], entries[at_known, None] * X[columns[at_known]])
    inside, place = free[rows] & ~at_known, np.cumsum(free) - 1
    cells = (place[rows[inside]], place[columns[inside]])
    H = csc_array(coo_array((entries[inside], cells), shape=2 * (int(free.sum()),)))
    X[free] = splu(H, permc_spec="MMD_AT_PLUS_A", **_SYMMETRIC).solve(right[free])
    return X.reshape(given.shape)


def _nearest_rotations(matrices: Array) -> Array:
    """Rotations (N, d, d) nearest to matrices (N, d, d) in the Frobenius norm."""
    U, _, Vt = np.linalg.svd(matrices)
    U[..., -1] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return np.asarray(U @ Vt)
