"""How well edges of a pose graph fit a solution without them, with its uncertainty."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import splu

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.pose_graph.factors import make_factors, make_gauge, make_values
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph

SAMPLES = 100
SEED = 0


def predicted_chi2(graph: PoseGraph, used: Mask, edges: Ints) -> Array:
    """Chi-squares (A,) of edges against the solution of others, including its uncertainty.

    ``r^T (Sigma + J P J^T)^-1 r`` with r and J the residual and the Jacobian of one of ``edges``
    (A,), rows of the graph's edges, and P the covariance of the graph's poses, which are the
    optimum of the ``used`` edges (M,). To first order it is twice the increase of the optimal cost
    when that edge alone is added: a right edge stays below its quantile however far the solution
    has drifted.

    Raises:
        RuntimeError: the used edges do not determine all poses.
    """
    d = graph.information.shape[-1]
    A, b = _linearised(graph)
    rows = (edges[:, None] * d + np.arange(d)).ravel()
    moved = (A[rows] @ _draws(A, used, d)).reshape(-1, d, SAMPLES)
    S = np.eye(d) + moved @ moved.swapaxes(1, 2) / SAMPLES
    r = b[rows].reshape(-1, d)
    return np.einsum("ai,ai->a", r, np.linalg.solve(S, r[..., None])[..., 0])


def pose_draws(graph: PoseGraph, used: Mask) -> Array:
    """Tangents (SAMPLES, N, d) drawn from the posterior of all poses, given ``used`` edges (M,).

    In GTSAM's order: [rotation, translation], in a 2-D graph [x, y, angle]. Draws given different
    edge sets use the same errors of the edges, so that their spreads are comparable.
    """
    d = graph.information.shape[-1]
    return _draws(_linearised(graph)[0], used, d).T.reshape(SAMPLES, -1, d)


def _draws(A: csr_array, used: Mask, d: int) -> Array:
    """Draws (N d, SAMPLES) of all tangents: normal equations with random right-hand sides.

    ``x = H^-1 A^T e`` with ``H = A^T A`` and white e has the covariance ``H^-1``: a factorisation
    and one solve a draw, where covariances would need one for each pair of poses. The gauge has no
    error, so that the world is fixed.
    """
    with_gauge = np.append(used, np.ones(A.shape[0] // d - len(used), bool))
    rows = np.repeat(with_gauge, d)
    noise = np.random.default_rng(SEED).normal(size=(len(rows), SAMPLES))
    noise[len(used) * d :] = 0.0
    A, noise = A[rows], noise[rows]
    symmetric = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}
    factor = splu(csc_array(A.T @ A), permc_spec="MMD_AT_PLUS_A", **symmetric)
    return np.asarray(factor.solve(A.T @ noise))


def _linearised(graph: PoseGraph) -> tuple[csr_array, Array]:
    """Whitened Jacobian and residual: rows of edges, then of the gauge; columns of all poses."""
    factors = make_factors(graph)
    factors.push_back(make_gauge(graph))
    linear = factors.linearize(make_values(graph, graph.poses))
    i, j, entries = linear.sparseJacobian_()
    i, j = i.astype(np.int64) - 1, j.astype(np.int64) - 1
    columns = len(graph.ids) * graph.information.shape[-1]
    right = j == columns  # no entry at all where every residual is zero
    b = np.zeros(i.max() + 1)
    b[i[right]] = entries[right]
    i, j, entries = i[~right], j[~right], entries[~right]
    return csr_array((entries, (i, j)), shape=(len(b), columns)), b
