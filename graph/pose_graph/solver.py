"""GTSAM's optimisers on a pose graph: current values, weights of edges, steps taken."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.batch.iteration import Progress
from bmask_slam.graph.pose_graph.factors import (
    edge_chi_squares,
    make_factors,
    make_gauge,
    make_values,
    poses_of,
)
from bmask_slam.graph.pose_graph.pose_graph import PoseGraph

Method = Literal["lm", "dogleg", "gnc"]
NEARLY = 1e-2
ROUNDING = 1e-9  # of the cost: a step that raises it by less did not raise it


@dataclass(frozen=True)
class PoseGraphConfig:
    """Limits of the iterations, and the parameters of GNC.

    ``relative_tolerance`` is GTSAM's default, of all that is left to gain and not of the last step
    alone.
    """

    method: Method = "lm"
    max_iterations: int = 200
    relative_tolerance: float = 1e-5
    inlier_probability: float = 0.999
    gnc_step: float = 1.4
    gnc_inner_iterations: int = 3


@dataclass(frozen=True)
class Descent:
    """How the cost fell in some steps.

    Attributes:
        cost: after the last step.
        fall: by how much the last step lowered it.
        steps: how many there were.
        converged: whether what is left to gain is below the tolerance's share of the cost: the last
            fall, or, since falls shrink at least geometrically near an optimum, all further ones.
    """

    cost: float
    fall: float = np.inf
    steps: int = 0
    converged: bool = False

    @property
    def is_nearly_converged(self) -> bool:
        """Whether the last step changed the cost by less than a hundredth."""
        return self.fall < NEARLY * self.cost

    def next(self, cost: float, tolerance: float) -> Descent:
        """After one more step to a new cost."""
        fall = self.cost - cost
        shrinking = fall / self.fall if 0 < fall < self.fall else 1.0
        limit = tolerance * self.cost
        further = fall * shrinking / (1 - shrinking) if shrinking < 1 else np.inf
        converged = fall <= limit or (np.isfinite(self.fall) and further <= tolerance * cost)
        return Descent(cost, fall, self.steps + 1, bool(converged))


class PoseGraphSolver:
    """GTSAM factors of a graph, their weights, current values, and the steps taken so far."""

    def __init__(self, graph: PoseGraph, config: PoseGraphConfig, progress: Progress) -> None:
        self._graph, self._config, self._progress = graph, config, progress
        self._edges = make_factors(graph)
        self._gauge = make_gauge(graph)
        self._factors = self._edges
        self.weigh(np.ones(len(graph.edges)))
        self.values = gtsam.Values()  # GTSAM's current values, none before `poses` is set
        self.iterations = 0

    @property
    def poses(self) -> Array:
        """Current poses (N, 4, 4)."""
        return poses_of(self._graph, self.values)

    @poses.setter
    def poses(self, poses: Array) -> None:
        self.values = make_values(self._graph, poses)

    def chi_squares(self) -> Array:
        """(M,) squared whitened residuals of all edges, weight 1, at the current values."""
        return edge_chi_squares(self._graph, self.poses)

    def weigh(self, weights: Array) -> None:
        """Scale the information of each edge by weights (M,); edges of weight 0 are left out."""
        factors = gtsam.NonlinearFactorGraph(self._gauge)
        whole = weights == 1.0
        if whole.all():
            factors.push_back(self._edges)
        else:
            for k in np.flatnonzero(whole).tolist():
                factors.add(self._edges.at(k))
        partly = np.flatnonzero((weights > 0) & ~whole)
        if len(partly):
            scaled = self._graph.with_edges(partly)
            information = weights[partly, None, None] * scaled.information
            factors.push_back(make_factors(scaled, information))
        self._factors = factors

    def run(self, max_iterations: int, before: Descent | None = None) -> Descent:
        """Iterate to convergence or for so many steps; the cost is that of the weighted edges.

        ``before`` is the descent that ended at the current values with the same weights.

        Gauss-Newton as long as its steps lower the cost, then Levenberg-Marquardt (or dogleg, if
        that is the method): a graph's weakest directions, a long path that closes late, are often
        far weaker than Levenberg-Marquardt's first damping, which then takes several steps.
        """
        if before is not None and before.converged:
            return before
        undamped = self._config.method != "dogleg"
        optimiser = self._optimiser(undamped)
        descent = before or Descent(float(optimiser.error()))
        while descent.steps < max_iterations and not descent.converged:
            if not self._step(optimiser, descent.cost) and undamped:
                undamped, optimiser = False, self._optimiser(False)
                continue
            descent = descent.next(float(optimiser.error()), self._config.relative_tolerance)
            self.values = gtsam.Values(optimiser.values())  # the optimiser frees its own
            self.iterations += 1
            self._progress(self.iterations, descent.cost)
        return descent

    @staticmethod
    def _step(optimiser: Any, cost: float) -> bool:
        """One iteration; whether it succeeded and the cost did not rise.

        A step of Gauss-Newton that raises it gets a second one: across a curved valley the first
        overshoots and the second lands near the bottom, along which damped steps would creep.
        """
        if not isinstance(optimiser, gtsam.GaussNewtonOptimizer):
            optimiser.iterate()
            return True
        try:
            for _ in range(2):
                optimiser.iterate()
                if optimiser.error() <= cost * (1 + ROUNDING):
                    return True
        except RuntimeError:  # undetermined without damping
            return False
        return False

    def _optimiser(self, undamped: bool) -> Any:
        if undamped:
            return gtsam.GaussNewtonOptimizer(self._factors, self.values)
        if self._config.method == "dogleg":
            return gtsam.DoglegOptimizer(self._factors, self.values, gtsam.DoglegParams())
        return gtsam.LevenbergMarquardtOptimizer(
            self._factors, self.values, gtsam.LevenbergMarquardtParams()
        )
