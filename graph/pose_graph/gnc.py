"""Wrong loops of a pose graph, by graduated non-convexity on the edges that may be right."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.factors.checks import chi2_quantile
from bmask_slam.graph.factors.gnc import first_mu, gnc_weights
from bmask_slam.graph.pose_graph.loop_consistency import LoopConsistency
from bmask_slam.graph.pose_graph.loop_prediction import predicted_chi2
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph, is_connected
from bmask_slam.graph.pose_graph.solver import PoseGraphConfig, PoseGraphSolver

LEAST_WEIGHT = 1e-6  # if odometry does not connect: vertices with a single edge stay solvable
MAX_ROUNDS = 20


def find_wrong_loops(
    graph: PoseGraph, solver: PoseGraphSolver, config: PoseGraphConfig, loops: LoopConsistency
) -> Mask:
    """(M,) the wrong edges: without them a truncated least-squares cost is minimal.

    Candidates are the loops that the solution of odometry and consistent loops does not contradict,
    with its own uncertainty: no random edges, but right ones that close a long drift. GNC (Yang et
    al., RA-L 2020) then decides among the candidates. Those that it keeps may make others
    candidates, so this is repeated while the cost falls. Random edges would fill the factorisation
    and are left out of it from the start.

    Odometry edges keep weight 1. If they do not connect the graph, or no loops are consistent, GNC
    starts with all loops. The solver ends at the solution of the right edges.
    """
    search = _Search(graph, solver, config, loops.noise_scale)
    known = search.known
    if not is_connected(graph.with_edges(known)):
        solver.run(config.gnc_inner_iterations)
        is_right = search.inliers(~known, LEAST_WEIGHT)
        return ~is_right & ~_needed(graph, np.where(is_right, 1e-3, solver.chi_squares()))
    right = known | loops.consistent
    if not loops.consistent.any():
        solver.run(config.gnc_inner_iterations)
        right = search.inliers(~known)
    cost = search.solve(right)
    for _ in range(MAX_ROUNDS):
        poses = solver.poses
        allowed = right | search.candidates(right)
        if (allowed > right).any():
            search.solve(allowed)
        tried = search.inliers(allowed & ~known)
        if (tried == right).all():
            break
        new_cost = search.solve(tried)
        if new_cost >= cost * (1 - config.relative_tolerance):
            solver.poses = poses
            break
        right, cost = tried, new_cost
    return ~right


class _Search:
    """Solutions of one graph with different sets of loops."""

    def __init__(
        self, graph: PoseGraph, solver: PoseGraphSolver, config: PoseGraphConfig, noise_scale: float
    ) -> None:
        self._graph, self._solver, self._config = graph, solver, config
        degrees = graph.information.shape[-1]
        self.limit = noise_scale * float(chi2_quantile(config.inlier_probability, degrees))
        self.known = graph.is_odometry

    def solve(self, right: Mask) -> float:
        """Solve with these edges (M,); the truncated cost, in which the others are at the bound."""
        self._solver.weigh(right.astype(float))
        self._solver.run(self._config.max_iterations)
        c = self._solver.chi_squares()
        loops = np.minimum(c[~self.known], self.limit).sum()
        return 0.5 * float(c[self.known].sum() + loops)

    def candidates(self, used: Mask) -> Mask:
        """(M,) the other edges that the solution of ``used``, the solver's, does not contradict."""
        unused = np.flatnonzero(~used)
        candidates = np.zeros(len(used), bool)
        if len(unused):
            predicted = predicted_chi2(self._graph.with_poses(self._solver.poses), used, unused)
            candidates[unused[predicted <= self.limit]] = True
        return candidates

    def inliers(self, loops: Mask, least: float = 0.0) -> Mask:
        """(M,) the right edges, by GNC on these loops (M,) from the solver's current values.

        mu starts where the cost is convex and grows until every weight is 0 or 1.
        """
        solver, config, weights = self._solver, self._config, np.ones(len(loops))
        weights[~loops & ~self.known] = 0.0
        chi_squares = solver.chi_squares()[loops]
        if not (chi_squares > self.limit).any():
            return weights > 0.5

        def solve(of_loops: Array) -> Array:
            weights[loops] = np.maximum(of_loops, least)
            solver.weigh(weights)
            solver.run(config.gnc_inner_iterations)
            return solver.chi_squares()[loops]

        mu = first_mu(chi_squares, self.limit)
        weights[loops] = gnc_weights(
            chi_squares, self.limit, mu, config.gnc_step, config.max_iterations, solve
        )
        return weights > 0.5


def _needed(graph: PoseGraph, costs: Array) -> Mask:
    """(M,) edges of the cheapest spanning tree, which keep the graph connected."""
    size = len(graph.ids)
    low, high = np.sort(graph.edges, axis=1).T
    order = np.lexsort((costs, high, low))
    pairs = np.stack([low, high])[:, order]
    cheapest = order[np.r_[True, (np.diff(pairs) != 0).any(axis=0)]]  # of edges of the same pair
    weights = coo_array((costs[cheapest], (low[cheapest], high[cheapest])), shape=(size, size))
    tree = minimum_spanning_tree(weights.tocsr()).tocoo()
    in_tree = np.isin(low * size + high, tree.row.astype(np.int64) * size + tree.col)
    needed = np.zeros(len(costs), bool)
    needed[cheapest] = in_tree[cheapest]
    return needed
