"""Full bundle adjustment of a saved graph: robust, then loops by GNC, then without outliers.

Three stages, each from the result of the one before:

1. **robust**: Levenberg-Marquardt on all factors, with the kernels of the run.
2. **loops**: graduated non-convexity decides which loop edges are right. Observations and all other
   relative poses are known inliers (the former keep their kernel). Wrong loops are removed.
3. **inliers**: observations whose chi-square without a kernel is beyond the bound are removed, with
   the landmarks that are then underconstrained; the rest is optimised again.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.batch.iteration import Progress, iterate
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.checks import (
    OBSERVATION_PROBABILITY,
    chi2_quantile,
    wrong_observations,
)
from bmask_slam.graph.factors.factor_tables import FactorTables, ids_array
from bmask_slam.graph.factors.gnc import first_mu, gnc_weights
from bmask_slam.graph.factors.graph_update import LOOP, GraphUpdate, RelativePose
from bmask_slam.graph.factors.gtsam_factors import FactorMaker, make_graph, make_values, read_values
from bmask_slam.graph.factors.own_factors import own_gtsam_factors
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.inertial.preintegration import inertial_graph, insert_states, read_states
from bmask_slam.graph.smoother.removal import remove


@dataclass(frozen=True)
class AdjustmentConfig:
    """How long to iterate, and what counts as an outlier.

    Attributes:
        loop_probability, observation_probability: the share of right ones that the chi-square
            tests keep. Observations have the bounds of tracking, 7.815 with depth and 5.991
            without, since there are many; there are few loops.
        gnc_step, gnc_inner_iterations: growth of mu, and solver steps at each.
        drop_observations: whether there is a third stage.
    """

    max_iterations: int = 100
    relative_tolerance: float = 1e-7
    loop_probability: float = 0.999
    observation_probability: float = OBSERVATION_PROBABILITY
    gnc_step: float = 2.0
    gnc_inner_iterations: int = 2
    drop_observations: bool = True


@dataclass(frozen=True)
class Stage:
    """One optimisation: number of factors, cost before and after, solver steps."""

    name: str
    factors: int
    cost_before: float
    cost_after: float
    iterations: int


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What a bundle adjustment did.

    Attributes:
        stages: in their order; costs are half the sum of squared whitened errors, with kernels.
        loops: number of loop edges before.
        wrong_loops: (N, 2) keyframe ids of the loop edges that were removed.
        observations: number of observations before.
        wrong_observations: (N, 2) keyframe id, landmark id of those that were removed.
        dropped_landmarks: (N,) ids of the landmarks that were then underconstrained.
        duration_ms: wall time.
    """

    stages: tuple[Stage, ...]
    loops: int
    wrong_loops: Ints
    observations: int
    wrong_observations: Ints
    dropped_landmarks: Ints
    duration_ms: float

    @property
    def initial_cost(self) -> float:
        """The cost before the first stage."""
        return self.stages[0].cost_before

    @property
    def final_cost(self) -> float:
        """The cost after the last stage, without what was removed."""
        return self.stages[-1].cost_after

    @property
    def iterations(self) -> int:
        """Solver steps altogether."""
        return sum(stage.iterations for stage in self.stages)


def adjust(
    tables: FactorTables,
    camera: Camera,
    smoother_config: SmootherConfig | None = None,
    config: AdjustmentConfig | None = None,
    progress: Progress = lambda iteration, cost: None,
) -> Adjustment:
    """Adjust a graph in place: its values are optimised, its outliers removed.

    Raises:
        InputError: the graph is empty or cannot be solved, with GTSAM's reason.
    """
    begin_s = time.perf_counter()
    if not len(tables.keyframes.ids):
        raise InputError("the graph holds no keyframe; nothing to optimise")
    observations = len(tables.observations)
    adjuster = _Adjuster(tables, camera, smoother_config or SmootherConfig(), config, progress)
    try:
        adjuster.optimise("robust")
        loops = loop_numbers(tables)
        wrong_loops = adjuster.drop_wrong_loops() if loops else np.zeros((0, 2), np.int64)
        wrong, dropped = adjuster.drop_wrong_observations()
    except RuntimeError as error:  # GTSAM's exceptions all arrive as this
        reason = str(error).strip().split("\n\n")[0]
        raise InputError(f"the graph cannot be solved: {reason}") from error
    return Adjustment(
        stages=tuple(adjuster.stages),
        loops=len(loops),
        wrong_loops=wrong_loops,
        observations=observations,
        wrong_observations=wrong,
        dropped_landmarks=dropped,
        duration_ms=1e3 * (time.perf_counter() - begin_s),
    )


def loop_edges(tables: FactorTables) -> Ints:
    """Keyframe ids (N, 2) of the loop edges."""
    edges = [tables.pose_factors[number].keyframes for number in loop_numbers(tables)]
    return np.array(edges, np.int64).reshape(-1, 2)


def loop_numbers(tables: FactorTables) -> list[int]:
    """Numbers of the loop edges."""
    factors = tables.pose_factors
    return sorted(n for n in factors if getattr(factors[n].factor, "kind", "") == LOOP)


class _Adjuster:
    """Factor tables, the GTSAM factors made of them, and the stages so far."""

    def __init__(
        self,
        tables: FactorTables,
        camera: Camera,
        smoother_config: SmootherConfig,
        config: AdjustmentConfig | None,
        progress: Progress,
    ) -> None:
        self._tables, self._camera = tables, camera
        self._smoother_config, self._config = smoother_config, config or AdjustmentConfig()
        self._progress = progress
        self._maker = FactorMaker(camera, smoother_config)
        self._done = 0
        self.stages: list[Stage] = []

    def optimise(self, name: str) -> None:
        """A stage: optimise with all factors, to convergence."""
        graph = self._graph(sorted(self._tables.pose_factors))
        before = float(graph.error(self._values()))
        done = self._done
        after = self._run(graph, self._config.max_iterations)
        self.stages.append(Stage(name, graph.size(), before, after, self._done - done))

    def drop_wrong_loops(self) -> Ints:
        """Decide on the loop edges by GNC; keyframes (N, 2) of those that were removed.

        The right ones have no kernel until the end of this stage, so that they take full effect.
        """
        numbers = loop_numbers(self._tables)
        loops = [self._loop(number) for number in numbers]
        plain = make_graph([self._maker.pose_factor(loop) for loop in loops])
        others = self._graph(sorted(set(self._tables.pose_factors) - set(numbers)))
        limit = float(chi2_quantile(self._config.loop_probability, 6))

        def chi_squares() -> Array:
            values = self._values()
            return 2 * np.array([plain.at(k).error(values) for k in range(plain.size())])

        def solve(weights: Array) -> Array:
            graph = gtsam.NonlinearFactorGraph(others)
            for loop, weight in zip(loops, weights.tolist(), strict=True):
                if weight > 0:
                    weighted = replace(loop, covariance=loop.covariance / weight)
                    graph.add(self._maker.pose_factor(weighted))
            self._run(graph, self._config.gnc_inner_iterations)
            return chi_squares()

        now = chi_squares()
        if not (now > limit).any():
            return np.zeros((0, 2), np.int64)
        steps, done = self._config.max_iterations, self._done
        before = self.stages[-1].cost_after
        mu = first_mu(now, limit)
        weights = gnc_weights(now, limit, mu, self._config.gnc_step, steps, solve)
        wrong = [number for number, weight in zip(numbers, weights, strict=True) if weight < 0.5]
        edges = np.array([self._tables.pose_factors[n].keyframes for n in wrong], np.int64)
        self._tables.remove_pose_factors(wrong)
        graph = self._graph(sorted(self._tables.pose_factors))
        after = self._run(graph, steps)
        self.stages.append(Stage("loops", graph.size(), before, after, self._done - done))
        return edges.reshape(-1, 2)

    def drop_wrong_observations(self) -> tuple[Ints, Ints]:
        """Pairs (N, 2) of the observations that were removed, and the landmarks (N,) with them."""
        probability = self._config.observation_probability
        pairs = wrong_observations(self._tables, self._camera, probability)
        if not (len(pairs) and self._config.drop_observations):
            return np.zeros((0, 2), np.int64), ids_array([])
        update = GraphUpdate(remove_observations=pairs)
        removal = remove(update, self._tables, self._smoother_config)
        self.optimise("inliers")
        return pairs, removal.dropped_landmarks

    def _loop(self, number: int) -> RelativePose:
        """A loop edge without its kernel."""
        factor = self._tables.pose_factors[number].factor
        assert isinstance(factor, RelativePose)
        return replace(factor, robust=None)

    def _graph(self, numbers: list[int]) -> gtsam.NonlinearFactorGraph:
        """All observations, and the pose factors of these numbers."""
        table = self._tables.observations
        factors = self._maker.observations(table.all())
        chosen = [self._tables.pose_factors[number].factor for number in numbers]
        factors += [self._maker.pose_factor(factor) for factor in chosen]
        inertial = inertial_graph(self._tables.inertial)[0]
        return make_graph([*factors, *own_gtsam_factors(self._tables), *inertial])

    def _values(self) -> gtsam.Values:
        keyframes, landmarks = self._tables.keyframes, self._tables.landmarks
        values = make_values(keyframes.ids, keyframes.values, landmarks.ids, landmarks.values)
        insert_states(values, self._tables.inertial, inertial_graph(self._tables.inertial)[1])
        return values

    def _run(self, graph: gtsam.NonlinearFactorGraph, max_iterations: int) -> float:
        """Iterate, write the values into the factor tables; returns the final cost."""
        parameters = gtsam.LevenbergMarquardtParams()
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, self._values(), parameters)
        done = self._done
        cost, steps = iterate(
            optimiser,
            max_iterations,
            self._config.relative_tolerance,
            lambda step, cost: self._progress(done + step, cost),
        )
        if not np.isfinite(cost):
            raise RuntimeError(f"the cost is {cost}")
        self._done += steps
        poses, points = read_values(optimiser.values())
        landmarks = self._tables.landmarks
        self._tables.keyframes.values = poses
        landmarks.values = points[: len(landmarks.ids)]
        if not read_states(optimiser.values(), self._tables.inertial):
            raise RuntimeError("an inertial state is not finite")
        return cost
