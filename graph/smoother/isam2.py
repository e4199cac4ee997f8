"""ISAM2 behind a numpy border: the one place where its failures are translated."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.factors.gtsam_factors import FactorMaker, make_graph, make_values, read_values
from bmask_slam.graph.factors.keys import keyframe_keys, landmark_keys, variable_named_in
from bmask_slam.graph.factors.own_factors import (
    Variable,
    exchange_own_factors,
    failing,
    own_gtsam_factors,
)
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.inertial.preintegration import (
    inertial_factors,
    inertial_graph,
    insert_states,
    predict_new_states,
    read_states,
)
from bmask_slam.graph.inertial.tables import InertialChange
from bmask_slam.graph.marginals.covariances import Marginals, marginals_of
from bmask_slam.graph.smoother.elimination import RootPoints, add_root, poses_last


class SolverError(Exception):
    """ISAM2 could not solve; it is discarded and must be rebuilt from the factor tables."""

    def __init__(self, message: str, variable: Variable | None) -> None:
        super().__init__(message)
        self.variable = variable


@dataclass(frozen=True)
class Change:
    """What to pass to ISAM2.

    Attributes:
        rows: of new observations in the factor tables; numbers: of new pose factors; own: of a
            user's new factors.
        keyframe_ids, landmark_ids: new variables.
        removed_slots: of factors that were removed.
        inertial: new inertial factors and variables.
        max_iterations: how many further steps may follow.
    """

    rows: Ints = field(default_factory=no_ids)
    numbers: list[int] = field(default_factory=list)
    keyframe_ids: Ints = field(default_factory=no_ids)
    landmark_ids: Ints = field(default_factory=no_ids)
    removed_slots: list[int] = field(default_factory=list)
    max_iterations: int = 0
    own: tuple[int, ...] = ()
    inertial: InertialChange = field(default_factory=InertialChange)


def apply_user_and_inertial(
    change: Change, update: GraphUpdate, tables: FactorTables
) -> tuple[Change, list[int]]:
    """Carry out what an update does to users' and inertial factors, once its keyframes are there.

    Returns the change with them, and the numbers of the users' factors that were lost.
    """
    lost, slots, added = exchange_own_factors(update, tables)
    (inertial := tables.inertial).add(update.inertial)
    inertial.prune(tables.keyframes.ids)
    predict_new_states(inertial, tables.keyframes)
    new = inertial.change()
    slots = sorted([*change.removed_slots, *slots, *new.removed_slots])
    change = replace(change, own=added, inertial=new, max_iterations=update.max_iterations)
    return replace(change, removed_slots=slots), lost


class Solver:
    """An ISAM2 that is kept equal to factor tables; at first and after a failure it is rebuilt."""

    def __init__(self, camera: Camera, config: SmootherConfig) -> None:
        self._config = config
        self._maker = FactorMaker(camera, config)
        self._isam: gtsam.ISAM2 | None = None
        self._root = RootPoints()
        self.elapsed_s = 0.0
        """Time spent in GTSAM's update and read-back since this was last set to zero."""

    def reset(self) -> None:
        """Discard ISAM2; the next update rebuilds it from the factor tables."""
        self._isam = None

    def update(self, tables: FactorTables, change: Change) -> None:
        """Apply a change that the tables already contain, and read all values back into them.

        Raises SolverError; the values are then those of before.
        """
        if self._isam is None:
            self.rebuild(tables)
            return
        self._apply(tables, change)

    def rebuild(self, tables: FactorTables) -> None:
        """A new ISAM2 of all factors, linearised at the current values."""
        self._isam = None
        if not len(tables.keyframes.ids):
            return
        self._isam, self._root = gtsam.ISAM2(_parameters(self._config)), RootPoints()
        own = sorted(tables.own_factors.items())
        for _, one in own:
            one.slot = NO_SLOT
        tables.inertial.prune(tables.keyframes.ids)
        tables.inertial.slots = {}
        everything = Change(
            tables.observations.all_rows(),
            sorted(tables.pose_factors),
            tables.keyframes.ids,
            tables.landmarks.ids,
            own=tuple(number for number, one in own if tables.has_variables(one)),
            inertial=tables.inertial.change(),
        )
        self._apply(tables, everything)

    def optimise_batch(self, tables: FactorTables, max_iterations: int) -> tuple[float, float]:
        """Levenberg-Marquardt on all factors; the cost before and after.

        Raises SolverError; the values are then those of before.
        """
        self._isam = None
        if failing(tables):  # GTSAM would end without a step, and not say so
            raise SolverError("a user's factor cannot be evaluated", None)
        graph, values = self._everything(tables)
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setMaxIterations(max_iterations)
        parameters.setRelativeErrorTol(self._config.least_decrease)
        if (order := add_root(graph, values, tables.keyframes)) is not None:
            parameters.setOrdering(order)
        started_s = time.perf_counter()
        try:
            before = graph.error(values)
            values = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
            after = graph.error(values)
        except Exception as error:  # a user's factor may raise any
            raise self._failure(error) from error
        if not np.isfinite(after):
            raise SolverError(f"the cost is {after}", None)
        poses, points = read_values(values)
        points = points[: len(tables.landmarks.ids)]
        self.elapsed_s += time.perf_counter() - started_s
        self._check_finite(tables, poses, points)
        self._check_inertial(read_states(values, tables.inertial))
        tables.keyframes.values, tables.landmarks.values = poses, points
        return before, after

    def marginal_covariance(self, tables: FactorTables, keyframes: Ints, landmarks: Ints) -> Array:
        """Joint covariance of keyframes (6 each, ``[rad, m]``), then landmarks (3 each, m).

        From ISAM2, or from all factors at the current values if there is none.
        """
        keys = keyframe_keys(keyframes) + landmark_keys(landmarks)
        try:
            source = self._isam or gtsam.Marginals(*self._everything(tables))
            if len(keys) == 1:
                return np.asarray(source.marginalCovariance(keys[0]))
            joint = source.jointMarginalCovariance(keys)
            return np.block([[joint.at(a, b) for b in keys] for a in keys])
        except RuntimeError as error:
            raise self._failure(error) from error

    def marginals(self, tables: FactorTables, landmarks: Ints) -> Marginals:
        """Covariances of every keyframe and of some landmarks at the current values."""
        if not len(tables.keyframes.ids):
            return Marginals(tables.keyframes.ids, np.zeros((0, 6, 6)))
        try:
            graph, values = self._everything(tables)
            order = add_root(graph, values, tables.keyframes)
            return marginals_of(graph, values, tables.keyframes.ids, landmarks, order)
        except RuntimeError as error:
            raise SolverError(str(error).strip(), variable_named_in(str(error))) from error

    def _everything(self, tables: FactorTables) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
        """All factors and values, in an order that depends on the tables' contents alone."""
        rows, numbers = tables.observations.all_rows(), sorted(tables.pose_factors)
        factors = self._factors(tables, rows, numbers)
        tables.inertial.prune(tables.keyframes.ids)
        inertial, variables = inertial_graph(tables.inertial)
        graph = make_graph([*factors, *own_gtsam_factors(tables), *inertial])
        keyframes, landmarks = tables.keyframes, tables.landmarks
        values = make_values(keyframes.ids, keyframes.values, landmarks.ids, landmarks.values)
        insert_states(values, tables.inertial, variables)
        return graph, values

    def _factors(self, tables: FactorTables, rows: Ints, numbers: list[int]) -> list:
        factors = self._maker.observations(tables.observations.select(rows))
        return factors + [
            self._maker.pose_factor(tables.pose_factors[number].factor) for number in numbers
        ]

    def _apply(self, tables: FactorTables, change: Change) -> None:
        own = [tables.own_factors[number] for number in change.own]
        factors = self._factors(tables, change.rows, change.numbers)
        inertial = inertial_factors(tables.inertial, change.inertial.names)
        root = self._root.follow(tables.keyframes, change.keyframe_ids)
        graph = make_graph([*factors, *(one.factor for one in own), *root.factors, *inertial])
        change = replace(change, removed_slots=[*change.removed_slots, *root.removed_slots])
        values = make_values(
            change.keyframe_ids,
            tables.keyframes.get(change.keyframe_ids),
            change.landmark_ids,
            tables.landmarks.get(change.landmark_ids),
        )
        insert_states(values, tables.inertial, change.inertial)
        root.insert_points(values)
        slots, estimate = self._run(graph, values, change)
        poses, points = read_values(estimate)
        count = len(tables.landmarks.ids)
        others = len(tables.inertial.states) + len(self._root.keys)
        expected = len(tables.keyframes.ids), count + others
        if (len(poses), len(points)) != expected:
            self._isam = None
            raise SolverError("ISAM2 and the factor tables have different variables", None)
        points = points[:count]
        self._check_finite(tables, poses, points)
        tables.observations.set_slots(change.rows, np.array(slots[: len(change.rows)], np.int64))
        later = iter(slots[len(change.rows) :])
        for number in change.numbers:
            tables.pose_factors[number].slot = next(later)
        for one in own:
            one.slot = next(later)
        self._root.slots += [next(later) for _ in root.factors]
        tables.inertial.slots |= dict(zip(change.inertial.names, later, strict=True))
        self._check_inertial(read_states(estimate, tables.inertial))
        tables.keyframes.values, tables.landmarks.values = poses, points

    def _run(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, change: Change
    ) -> tuple[list[int], gtsam.Values]:
        assert self._isam is not None
        removed, started_s = change.removed_slots, time.perf_counter()
        try:
            keys = values.keys() if removed else []
            if any(self._isam.valueExists(key) for key in keys):
                self._isam.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), removed)
                removed = []  # an id that was removed is used again: remove it first
            result = self._isam.update(graph, values, removed, poses_last(graph, self._root.last))
            slots = result.getNewFactorsIndices()
            for _ in range(self._config.extra_iterations):
                self._iterate(self._isam)
            for _ in range(change.max_iterations):
                if self._iterate(self._isam).getVariablesRelinearized() == 0:
                    break
            return slots, self._isam.calculateEstimate()
        except Exception as error:  # a user's factor may raise any
            raise self._failure(error) from error
        finally:
            self.elapsed_s += time.perf_counter() - started_s

    def _iterate(self, isam: gtsam.ISAM2) -> gtsam.ISAM2Result:
        """A further step without new factors, in which root points stay the last."""
        if not self._root.keys:
            return isam.update()
        nothing = gtsam.NonlinearFactorGraph()
        return isam.update(nothing, gtsam.Values(), [], poses_last(nothing, self._root.last))

    def _failure(self, error: Exception) -> SolverError:
        self._isam = None
        first = str(error).strip().split("\n\n")[0].replace("\n", " ")
        return SolverError(first, variable_named_in(str(error)))

    def _check_inertial(self, finite: bool) -> None:
        if not finite:
            raise self._failure(ValueError("an inertial state is not finite"))

    def _check_finite(self, tables: FactorTables, poses: Array, points: Array) -> None:
        for name, ids, values in (
            ("landmark", tables.landmarks.ids, points),
            ("keyframe", tables.keyframes.ids, poses),
        ):
            bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
            if bad.any():
                self._isam = None
                raise SolverError("a value is not finite", (name, int(ids[bad][0])))


def _parameters(config: SmootherConfig) -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(config.relinearize_threshold)
    parameters.relinearizeSkip = config.relinearize_skip
    parameters.findUnusedFactorSlots = True
    parameters.evaluateNonlinearError = False
    parameters.setFactorization("CHOLESKY")
    return parameters
