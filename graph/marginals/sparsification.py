"""Nonlinear factor recovery: dense information on poses, replaced by a tree of relative poses.

Mazuran, Burgard and Tipaldi, "Nonlinear factor recovery for long-term SLAM", IJRR 2016: of all
graphs of relative poses with a given topology, the one nearest to the dense Gaussian in
Kullback-Leibler divergence. On a tree the solution is closed: each edge's covariance is the
dense one's marginal of that relative pose, and the divergence grows with the sum of their log
det, by which the tree is chosen (Chow and Liu 1968).

The allowed trees decide the cost of a long session. The best tree is a chain from keyframe to
keyframe, and chains of many visits make a wide graph, in which errors add up over every link. Here
a few keyframes are **bases**: the best tree connects them, and every other keyframe is connected to
one base. So the graph's core grows with the space that was observed, not with time, and long paths
have few links. A keyframe becomes a base when it shares too few of its landmarks with any; one that
comes back to a known place needs no new one.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.geometry import adjoint, inverse, se3_exp
from bmask_slam.graph.marginals.point_elimination import PoseInformation

_KNOWN_SIGMAS = np.array([0.05] * 3 + [0.1] * 3)
"""How well (rad, m) the relative poses are known without the marginalised observations. Some poses
observe only one or two of the landmarks, which alone would allow any pose, far from where the
linearisation holds. So this information is added before, and subtracted from the result."""
_FAR = 3.0
"""Largest distance, in those sigmas, of a measured relative pose from its current value; farther,
the linearisation does not hold, and part of the gradient is lost."""
_LEAST = 1.0
"""Information (rad^-2, m^-2) that makes every covariance finite; an edge with less is omitted."""


def recover(
    information: PoseInformation, edges: Ints, kind: str, at_rest: bool
) -> list[RelativePose]:
    """Relative poses on a tree (E, 2) of rows that replace the dense information.

    At rest, that is at the optimum of the whole graph, their gradient at the linearisation point is
    that of the dense cost, so that the graph stays there when these replace the observations. The
    tree is less stiff than the dense information; so away from an optimum the same gradient would
    carry it far beyond that of the dense cost, and farther each time that it is made again. There
    the relative poses are those of the dense Gaussian's mean, as the least divergence asks for.

    No measurement differs from the current relative pose by more than ``_FAR`` times
    ``_KNOWN_SIGMAS``.
    """
    count, poses = len(information.keyframe_ids), information.poses_world_camera
    anchor, covariance = _anchored(information)
    a, b = edges.T
    X = np.linalg.inv(_relative(covariance, poses, a, b))
    X -= np.linalg.inv(_relative(_known(count, anchor), poses, a, b))
    X = (X + np.swapaxes(X, 1, 2)) / 2 + _LEAST * np.eye(6)
    J_a = _jacobians(poses, a, b)
    if at_rest:
        xi = _tree_step(X, J_a, edges, information.g, anchor)
    else:
        xi = -np.einsum("kilj,lj->ki", covariance, information.g)
    moves = (J_a @ xi[a, :, None])[..., 0] + xi[b]
    moves /= np.maximum(1.0, np.linalg.norm(moves / _KNOWN_SIGMAS, axis=1) / _FAR)[:, None]
    T_a_b = inverse(poses[a]) @ poses[b] @ se3_exp(moves)
    covariances = np.linalg.inv(X)
    covariances = (covariances + np.swapaxes(covariances, 1, 2)) / 2
    ends = information.keyframe_ids[edges].tolist()
    useful = np.linalg.eigvalsh(X)[:, -1] > 2 * _LEAST
    return [
        RelativePose(ends[e][0], ends[e][1], T_a_b[e], covariances[e], kind=kind)
        for e in np.flatnonzero(useful).tolist()
    ]


def _tree_step(X: Array, J_a: Array, edges: Ints, g: Array, anchor: int) -> Array:
    """Tangents (K, 6) of the minimum of a tree of information X (E, 6, 6) with the gradient g."""
    count = len(g)
    J: Array = np.zeros((len(edges), 6, count, 6))
    J[np.arange(len(edges)), :, edges[:, 0]] = J_a
    J[np.arange(len(edges)), :, edges[:, 1]] = np.eye(6)
    J = np.delete(J, anchor, axis=2).reshape(len(edges), 6, 6 * (count - 1))
    H = np.einsum("eik,eij,ejl->kl", J, X, J, optimize=True)
    H += np.diag(np.tile(_KNOWN_SIGMAS**-2, count - 1))
    xi = -np.linalg.solve(H, np.delete(g, anchor, axis=0).ravel()).reshape(-1, 6)
    return np.insert(xi, anchor, 0.0, axis=0)


def spanning_tree(information: PoseInformation, is_base: Mask) -> Ints:
    """Pairs of rows (K - 1, 2): the best tree of bases, and each other pose with its best base."""
    count = len(is_base)
    _, covariance = _anchored(information)
    a, b = np.triu_indices(count, 1)
    cost = np.linalg.slogdet(_relative(covariance, information.poses_world_camera, a, b))[1]
    costs = np.zeros((count, count))
    costs[a, b] = costs[b, a] = cost - cost.min() + 1.0  # positive: zero would mean no edge
    bases, leaves = np.flatnonzero(is_base), np.flatnonzero(~is_base)
    tree = minimum_spanning_tree(costs[np.ix_(bases, bases)]).tocoo()
    trunk = np.stack([bases[tree.row], bases[tree.col]], axis=1)
    hanging = np.stack([bases[np.argmin(costs[np.ix_(leaves, bases)], axis=1)], leaves], axis=1)
    return np.sort(np.concatenate([trunk, hanging]).astype(np.int64), axis=1)


def with_new_bases(shared: Ints, is_base: Mask, share: float) -> Mask:
    """Bases (K,) bool such that each pose shares enough of its landmarks with one.

    ``shared`` (K, K) counts common landmarks. Of the poses left over, the one that covers most of
    them becomes the next base.
    """
    is_base = is_base.copy()
    enough = shared >= share * np.diag(shared)[:, None]
    while not (covered := is_base | enough[:, is_base].any(axis=1)).all():
        serves = (enough & ~covered[:, None]).sum(axis=0)
        is_base[np.argmax(np.where(covered, -1, serves))] = True
    return is_base


def _anchored(information: PoseInformation) -> tuple[int, Array]:
    """The best known pose, and the covariance (K, 6, K, 6) of all poses with this one fixed.

    Exact for relative poses, since the cost does not depend on the world frame.
    """
    count = len(information.keyframe_ids)
    anchor = int(np.argmax(np.einsum("kiki->k", information.H)))
    others = np.delete(np.arange(count), anchor)
    size = 6 * (count - 1)
    H = information.H[others][:, :, others].reshape(size, size)
    H = H + np.diag(np.tile(_KNOWN_SIGMAS**-2, count - 1))
    covariance = np.zeros((count, 6, count, 6))
    blocks = np.linalg.inv(H).reshape(count - 1, 6, count - 1, 6)
    covariance[others[:, None], :, others] = np.swapaxes(blocks, 1, 2)
    return anchor, covariance


def _known(count: int, anchor: int) -> Array:
    """The same covariance without the observations."""
    covariance = np.zeros((count, 6, count, 6))
    others = np.delete(np.arange(count), anchor)
    covariance[others, :, others] = np.diag(_KNOWN_SIGMAS**2)
    return covariance


def _jacobians(poses: Array, a: Ints, b: Ints) -> Array:
    """d tangent of T_a^-1 T_b (right side) / d tangent of T_a, (E, 6, 6); by T_b it is 1."""
    return -adjoint(inverse(poses[b]) @ poses[a])


def _relative(covariance: Array, poses: Array, a: Ints, b: Ints) -> Array:
    """Covariances (E, 6, 6) of the tangents of T_a^-1 T_b, on its right side."""
    J = _jacobians(poses, a, b)
    across = J @ covariance[a, :, b]
    J_T = np.swapaxes(J, 1, 2)
    return J @ covariance[a, :, a] @ J_T + covariance[b, :, b] + across + np.swapaxes(across, 1, 2)
