"""GTSAM's optimisers on a pose graph: current values, weights of edges, steps taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.iteration import Progress, iterate
from bmask_slam.graph.pose_graph.factors import make_factors, make_gauge, make_values, poses_of
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph

Method = Literal["lm", "dogleg", "gnc"]


@dataclass(frozen=True)
class PoseGraphConfig:
    """Limits of the iterations, and the parameters of GNC."""

    method: Method = "lm"
    max_iterations: int = 200
    relative_tolerance: float = 1e-7
    inlier_probability: float = 0.999
    gnc_step: float = 1.4
    gnc_inner_iterations: int = 3


class PoseGraphSolver:
    """GTSAM factors of a graph, their weights, current values, and the steps taken so far."""

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
        """Current poses (N, 4, 4)."""
        return poses_of(self._graph, self._values)

    def start_from(self, poses: Array) -> None:
        """Set the current poses (N, 4, 4)."""
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
