"""Optimising a pose graph offline: Levenberg-Marquardt, dogleg, or robustly with GNC.

The cost is GTSAM's: half the sum of ``r^T Omega r``, with r the tangent of ``inverse(measurement) @
inverse(T_world_i) @ T_world_j``.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.stats import chi2

from graph.errors import InputError
from graph.geometry import Array
from graph.graduation import first_mu, graduate
from graph.iteration import Progress, iterate
from graph.loop_consistency import LoopSupport, loop_support
from graph.pose_graph import (
    Mask,
    PoseGraph,
    is_connected,
    spanning_tree_poses,
)
from graph.pose_graph_factors import (
    chordal_poses,
    make_factors,
    make_gauge,
    make_values,
    pose_graph_cost,
    poses_of,
)

Method = Literal["lm", "dogleg", "gnc"]
LEAST_WEIGHT = 1e-6  # where odometry does not connect: what one edge alone holds stays solvable


@dataclass(frozen=True)
class PoseGraphConfig:
    """How long to iterate, and what GNC takes for an outlier."""

    method: Method = "lm"
    max_iterations: int = 200
    relative_tolerance: float = 1e-7
    inlier_probability: float = 0.999
    gnc_step: float = 1.4
    gnc_inner_iterations: int = 3


@dataclass(frozen=True, eq=False)
class PoseGraphResult:
    """An optimised graph and how it came about.

    Attributes:
        graph: the input with the optimised poses, all edges still in it.
        given: where the poses before come from: file, or odometry where the file has none.
        given_poses: (N, 4, 4) those, and given_cost their cost.
        start: the initial value that was taken: file, odometry or chordal.
        initial_cost, final_cost: from there to the end, the latter without the outliers.
        iterations: solver steps altogether.
        is_outlier: (M,) bool, edges that GNC found wrong; never an odometry edge.
        duration_ms: wall time without reading and writing.
    """

    graph: PoseGraph
    method: Method
    given: str
    given_poses: Array
    given_cost: float
    start: str
    initial_cost: float
    final_cost: float
    iterations: int
    is_outlier: Mask
    duration_ms: float


def optimise_pose_graph(
    graph: PoseGraph,
    config: PoseGraphConfig | None = None,
    progress: Progress = lambda iteration, cost: None,
) -> PoseGraphResult:
    """Optimise a connected pose graph from the best initial value that is at hand.

    The gauge is held by the fixed vertices, or by the first if none is fixed.

    Raises:
        InputError: the graph cannot be solved, whatever the reason is that GTSAM gives.
    """
    config = config or PoseGraphConfig()
    begin_s = time.perf_counter()
    solver = _Solver(graph, config, progress)
    try:
        is_outlier = np.zeros(len(graph.edges), bool)
        support, trusted = None, ~is_outlier
        if config.method == "gnc":
            support = loop_support(graph)
            trusted = support.supported | graph.is_odometry
            trusted = trusted if support.supported.any() else ~is_outlier
        given = "file" if graph.has_poses else "odometry"
        given_poses = graph.poses if graph.has_poses else spanning_tree_poses(graph)
        start, poses = _best_start(graph, {given: given_poses}, trusted)
        solver.start_from(poses)
        if support is not None:
            is_outlier = _graduated_non_convexity(graph, solver, config, support)
        solver.weigh(np.where(is_outlier, 0.0, 1.0))
        final_cost = solver.run(config.max_iterations)
    except RuntimeError as error:  # GTSAM's exceptions all arrive as this
        raise InputError(f"the pose graph cannot be solved: {error}") from error
    return PoseGraphResult(
        graph=graph.with_poses(solver.poses),
        method=config.method,
        given=given,
        given_poses=given_poses,
        given_cost=solver.cost(given_poses),
        start=start,
        initial_cost=solver.cost(poses),
        final_cost=final_cost,
        iterations=solver.iterations,
        is_outlier=is_outlier,
        duration_ms=1e3 * (time.perf_counter() - begin_s),
    )


class _Solver:
    """A graph in GTSAM's terms, its current values, and the steps taken so far."""

    def __init__(self, graph: PoseGraph, config: PoseGraphConfig, progress: Progress) -> None:
        self._graph, self._config, self._progress = graph, config, progress
        self._edges = make_factors(graph)
        self._gauge = make_gauge(graph)
        self._factors = self._edges
        self.weigh(np.ones(len(graph.edges)))
        self._values = make_values(graph, graph.poses)
        self.iterations = 0

    @property
    def poses(self) -> Array:
        """(N, 4, 4) where the solver stands."""
        return poses_of(self._graph, self._values)

    def start_from(self, poses: Array) -> None:
        """Go to poses (N, 4, 4)."""
        self._values = make_values(self._graph, poses)

    def cost(self, poses: Array) -> float:
        """Cost of all edges, weight 1, at poses (N, 4, 4)."""
        return float(self._edges.error(make_values(self._graph, poses)))

    def chi_squares(self) -> Array:
        """(M,) squared whitened residuals of all edges, weight 1, at the current values."""
        factors, values = self._edges, self._values
        return 2 * np.array([factors.at(k).error(values) for k in range(factors.size())])

    def weigh(self, weights: Array) -> None:
        """Scale the information of each edge by weights (M,); edges of weight 0 are left out."""
        factors = gtsam.NonlinearFactorGraph(self._gauge)
        for k in np.flatnonzero(weights == 1.0).tolist():
            factors.push_back(self._edges.at(k))
        partly = np.flatnonzero((weights > 0) & (weights != 1.0))
        scaled = self._graph.with_edges(partly)
        information = weights[partly, None, None] * scaled.information
        factors.push_back(make_factors(scaled, information))
        self._factors = factors

    def run(self, max_iterations: int) -> float:
        """Iterate to convergence or for so many steps; returns the cost of the weighted edges."""
        optimiser, done = self._optimiser(), self.iterations
        cost, steps = iterate(
            optimiser,
            max_iterations,
            self._config.relative_tolerance,
            lambda step, cost: self._progress(done + step, cost),
        )
        self.iterations += steps
        self._values = optimiser.values()
        return cost

    def _optimiser(self) -> Any:
        if self._config.method == "dogleg":
            return gtsam.DoglegOptimizer(self._factors, self._values, gtsam.DoglegParams())
        return gtsam.LevenbergMarquardtOptimizer(
            self._factors, self._values, gtsam.LevenbergMarquardtParams()
        )


# --- initial value -------------------------------------------------------------------------------


def _best_start(graph: PoseGraph, given: dict[str, Array], trusted: Mask) -> tuple[str, Array]:
    """Name and poses of the cheapest initial value, judged by the trusted edges (M,) alone.

    Where several vertices are fixed, the given poses: the chordal solution knows of one anchor.
    """
    if graph.fixed.sum() > 1:
        return next(iter(given.items()))
    judged = graph.with_edges(trusted)
    candidates = {**given, "chordal": chordal_poses(judged)}
    costs = {name: pose_graph_cost(judged.with_poses(T)) for name, T in candidates.items()}
    name = min(costs, key=lambda key: costs[key])
    return name, candidates[name]


# --- graduated non-convexity ---------------------------------------------------------------------


def _graduated_non_convexity(
    graph: PoseGraph, solver: _Solver, config: PoseGraphConfig, support: LoopSupport
) -> Mask:
    """(M,) the wrong edges: GNC with truncated least squares (Yang et al., RA-L 2020).

    mu starts where the cost is convex and grows until every weight is 0 or 1. From the solution of
    odometry and the loops that others confirm it starts later, where the worst of these still
    counts: what disagrees more is out at once. This is also what keeps it quick, since random edges
    fill the factorisation. Odometry edges keep weight 1. The solver is left at the solution.
    """
    degrees = graph.information.shape[-1]
    limit = support.noise_scale * float(chi2.ppf(config.inlier_probability, degrees))
    known = graph.is_odometry
    least = 0.0 if is_connected(graph.with_edges(known)) else LEAST_WEIGHT
    confirmed = support.supported[~known]
    if confirmed.any():
        solver.weigh((known | support.supported).astype(float))
        solver.run(config.max_iterations)
    else:
        solver.run(config.gnc_inner_iterations)
    chi_squares = solver.chi_squares()[~known]
    if not (chi_squares > limit).any():
        return np.zeros(len(known), bool)
    mu = first_mu(chi_squares, limit)
    if confirmed.any():
        worst = float(chi_squares[confirmed].max())
        mu = max(mu, limit / max(worst - limit, limit))

    def solve(weights: Array) -> Array:
        all_weights = np.ones(len(known))
        all_weights[~known] = np.maximum(weights, least)
        solver.weigh(all_weights)
        solver.run(config.gnc_inner_iterations)
        return solver.chi_squares()[~known]

    weights, chi_squares = graduate(
        chi_squares, limit, mu, config.gnc_step, config.max_iterations, solve
    )
    is_outlier, costs = np.zeros(len(known), bool), np.full(len(known), 1e-3)
    is_outlier[~known] = weights < 0.5
    costs[is_outlier] = chi_squares[weights < 0.5]
    return is_outlier & ~_needed(graph, costs)


def _needed(graph: PoseGraph, costs: Array) -> Mask:
    """(M,) edges of the cheapest tree: without them a vertex would hang loose."""
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
