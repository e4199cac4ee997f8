"""The factor graph of keyframe poses and landmarks, kept optimal by ISAM2."""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints, no_ids, no_pairs
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.checks import (
    observation_errors,
    relative_pose_errors,
    wrong_observations,
)
from bmask_slam.graph.factors.factor_tables import FactorTables, ValueTable
from bmask_slam.graph.factors.graph_estimate import (
    GraphEstimate,
    ObservationErrors,
    RelativePoseErrors,
)
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, RelativePose
from bmask_slam.graph.factors.own_factors import without_own
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.inertial.tables import InertialTables
from bmask_slam.graph.marginals.covariances import Marginals
from bmask_slam.graph.marginals.landmark_marginalisation import (
    Marginalisation,
    marginalise_landmarks,
    reinsert,
    remove_marginalised,
)
from bmask_slam.graph.marginals.summaries import mark_retracted, mark_returned, with_returning
from bmask_slam.graph.smoother.anchoring import anchor_components, release_anchors, with_first_prior
from bmask_slam.graph.smoother.isam2 import Change, Solver, SolverError, apply_user_and_inertial
from bmask_slam.graph.smoother.removal import Removal, remove, with_lost_removed
from bmask_slam.graph.smoother.repair import repair, solve_without_own
from bmask_slam.graph.smoother.storage import (
    factor_tables_of,
    graph_arrays,
    read_graph,
    write_graph,
)
from bmask_slam.graph.smoother.update_report import UpdateReport
from bmask_slam.graph.smoother.validation import Validated, validate

__all__ = ["Smoother", "SmootherConfig"]
logger = logging.getLogger(__name__)

REMEASURED_ITERATIONS = 20
"""Of the adjustment after the camera's times were changed, which is a small change."""


class Smoother:
    """Keyframe poses and landmarks under ISAM2, with factor tables that survive its failures.

    An update never raises for what it adds: what cannot enter is refused with a reason, and a
    failure of ISAM2 is repaired and reported in the estimate (``GraphEstimate.notes``). The first
    keyframe gets a prior at its initial value unless the first update brings one.
    """

    def __init__(self, camera: Camera, config: SmootherConfig | None = None) -> None:
        self._camera = camera
        self._config = config or SmootherConfig()
        self._tables = FactorTables()
        self._solver = Solver(camera, self._config)

    def update(self, update: GraphUpdate) -> GraphEstimate:
        """Remove, add, optimise one step, and read all values back."""
        report = UpdateReport()
        self._solver.elapsed_s = 0.0
        tables, model = self._tables, (self._tables, self._camera, self._config)
        update = with_first_prior(update, tables, self._config)
        update = with_lost_removed(update, tables, self._config)
        # marginalised observations first: their new relative poses still hold the keyframes
        before = remove_marginalised(update, *model)
        removal = remove(update, tables, self._config)
        mark_retracted(removal.dropped_landmarks, tables.marginalised)
        marginalised = marginalise_landmarks(without_own(update, tables), *model)
        validated = validate(with_returning(update, tables, self._camera), *model)
        report.refused, report.refused_factors = validated.refused, validated.refused_factors
        report.add_removal(removal)
        entered = self._enter(validated, [before, removal, marginalised], report)
        change, report.lost_own = apply_user_and_inertial(entered, update, tables)
        report.new_own = change.own
        try:
            self._solver.update(self._tables, change)
        except SolverError as failure:
            ids = validated.keyframe_ids
            if not self._repair(failure, ids, report, self._solver.rebuild):
                self._retract(validated, change, report)
        return report.estimate(tables, self._solver.elapsed_s)

    def optimise_batch(
        self, max_iterations: int = 100, drop_outliers: bool = False
    ) -> GraphEstimate:
        """Full bundle adjustment (Levenberg-Marquardt, with the kernels) of the whole graph.

        With ``drop_outliers`` observations whose chi-square without the kernel is beyond the 95 %
        bound are then removed, and the graph is optimised again. Those of landmarks that came to
        lie behind the camera always are, and landmarks so far away that nothing constrains them.
        Marginalised ones come back with all observations, until they are marginalised again.
        ISAM2 is discarded and rebuilt from the result if another update comes. A failure is
        repaired as in an update; if that fails, the values stay and the costs are NaN.
        """
        report, costs = UpdateReport(), [(math.nan, math.nan)]
        self._solver.elapsed_s, model = 0.0, (self._tables, self._config)
        reinsert(self._tables, self._camera, self._config)

        def solve(tables: FactorTables) -> None:
            costs.append(self._solver.optimise_batch(tables, max_iterations))

        for last in (False, True) if drop_outliers else (True,):
            try:
                solve(self._tables)
            except SolverError as failure:
                if not self._repair(failure, no_ids(), report, solve):
                    logger.error("batch optimisation failed; the values stay as they were")
                    break
            wrong = no_pairs() if last else wrong_observations(self._tables, self._camera)
            update = with_lost_removed(GraphUpdate(remove_observations=wrong), *model, 1.0)
            report.add_removal(remove(update, *model))
        before, after = costs[-1]
        estimate = report.estimate(self._tables, self._solver.elapsed_s)
        return dataclasses.replace(estimate, cost_before=before, cost_after=after)

    def remeasure(self, camera: Camera, observations: Observations) -> GraphEstimate:
        """Replace measurements, as another camera gives them, and optimise the whole graph.

        Observations that are not in the graph are passed over.
        """
        self._camera, self._solver = camera, Solver(camera, self._config)
        reinsert(self._tables, camera, self._config)
        self._tables.observations.remeasure(observations)
        return self.optimise_batch(REMEASURED_ITERATIONS)

    def estimate(self) -> GraphEstimate:
        """The current estimate, without optimising."""
        return UpdateReport().estimate(self._tables, 0.0)

    def observation_errors(self) -> ObservationErrors:
        """Chi-square of every observation at the current estimate, to find outliers."""
        return observation_errors(self._tables, self._camera)

    def relative_poses(self, kind: str) -> tuple[RelativePose, ...]:
        """The relative poses of a kind, such as "loop", in the order in which they were added."""
        return self._tables.relative_poses(kind)

    def relative_pose_errors(
        self, kind: str, slack: Callable[[Array], Array] | None = None
    ) -> RelativePoseErrors:
        """Chi-square of every relative pose of a kind at the current estimate.

        ``slack`` gives covariances (N, 6, 6) to add, for measured T_a_b (N, 4, 4).
        """
        poses = self.relative_poses(kind)
        added = slack(np.array([k.T_a_b for k in poses]).reshape(-1, 4, 4)) if slack else None
        return relative_pose_errors(poses, self._tables.keyframes, added)

    def marginal_covariance(self, keyframe_id: int) -> Array:
        """Covariance (6, 6) of a pose's ``[rotation rad, translation m]`` on its right side.

        The true pose is about ``T_world_camera @ se3_exp(xi)``, xi ~ N(0, covariance).
        Raises KeyError for an unknown id.
        """
        return self.joint_covariance(np.array([keyframe_id]))

    def joint_covariance(self, keyframe_ids: Ints, landmark_ids: Ints | None = None) -> Array:
        """Joint covariance (6K + 3L square): keyframes in the given order, then landmarks."""
        landmarks = no_ids() if landmark_ids is None else landmark_ids
        _check_known(self._tables.keyframes, keyframe_ids)
        _check_known(self._tables.landmarks, landmarks)
        return self._solver.marginal_covariance(self._tables, keyframe_ids, landmarks)

    def marginals(self, landmark_ids: Ints | None = None) -> Marginals:
        """Covariances of every keyframe, and of some landmarks, from one factorisation.

        Raises KeyError for an unknown id, SolverError for a graph that cannot be solved.
        """
        landmarks = no_ids() if landmark_ids is None else landmark_ids
        _check_known(self._tables.landmarks, landmarks)
        return self._solver.marginals(self._tables, landmarks)

    def restart(self) -> None:
        """Discard ISAM2; the next update rebuilds it from the current values.

        So a run that restarts where it saves goes on exactly as one that is loaded from the file.
        """
        self._solver.reset()
        self._tables.marginalised.number_on()

    def state(self) -> Arrays:
        """Graph, values and ids as named arrays; ISAM2 is not among them, see ``restart``."""
        return graph_arrays(self._tables)

    def restore(self, state: Arrays, path: Path) -> None:
        """Restore a state that was read from a file. Raises InputError."""
        self._tables = factor_tables_of(state, path)
        self.restart()

    @property
    def tables(self) -> FactorTables:
        """The whole graph and its values, to be read and not changed."""
        return self._tables

    def save(self, path: Path) -> None:
        """Write the graph, its values and ids into one file, atomically."""
        write_graph(path, self._tables, self._camera)

    @classmethod
    def load(cls, path: Path, config: SmootherConfig | None = None) -> Smoother:
        """A smoother that continues from a saved graph. Raises InputError for a bad file."""
        tables, camera = read_graph(path)
        smoother = cls(camera, config)
        smoother._tables = tables
        return smoother

    def _enter(
        self, validated: Validated, done: Sequence[Removal | Marginalisation], report: UpdateReport
    ) -> Change:
        """Add what passed validation to the factor tables; returns what ISAM2 must be told."""
        self._tables.keyframes.insert(validated.keyframe_ids, validated.poses_world_camera)
        self._tables.landmarks.insert(validated.landmark_ids, validated.points_world)
        rows = self._tables.observations.add(validated.observations)
        mark_returned(validated.landmark_ids, self._tables.marginalised)
        numbers = [number for part in done for number in part.pose_factors]
        numbers += self._tables.add_pose_factors(validated.pose_factors)
        free, slots = release_anchors(validated.observations, self._tables, self._config)
        report.anchored_keyframes.difference_update(free.tolist())
        return Change(
            rows,
            [number for number in numbers if number in self._tables.pose_factors],
            validated.keyframe_ids,
            validated.landmark_ids,
            sorted([*slots, *(slot for part in done for slot in part.slots)]),
        )

    def _repair(
        self,
        failure: SolverError,
        new_keyframes: Ints,
        report: UpdateReport,
        solve: Callable[[FactorTables], None],
    ) -> bool:
        """Repair the factor tables and solve again until it works; returns whether it did.

        Users' factors go before anything else. The first attempt then removes only what is visibly
        loose, later ones the named variable too.
        """
        report.rebuilt = True
        removed, left = solve_without_own(failure, report.new_own, self._tables, solve)
        report.failed_own += removed
        if left is None:
            return True
        failure = left
        for attempt in range(self._config.max_repairs):
            report.failed = failure.variable or report.failed
            logger.warning("GTSAM failed near %s (%s)", report.failed_variable or "?", failure)
            if attempt == 1:
                self._tables.inertial = InertialTables()  # the graph goes on without an IMU
            named = failure.variable if attempt else None
            done = repair(named, new_keyframes, self._tables, self._camera, self._config)
            report.add_repair(done)
            mark_retracted(done.dropped_landmarks, self._tables.marginalised)
            try:
                solve(self._tables)
                return True
            except SolverError as again:
                failure = again
                if attempt and not done.changed:
                    break
        return False

    def _retract(self, validated: Validated, change: Change, report: UpdateReport) -> None:
        """Remove the whole update again, refused as SOLVER_FAILED."""
        undo = GraphUpdate(
            remove_keyframes=validated.keyframe_ids,
            remove_landmarks=validated.landmark_ids,
            remove_observations=validated.observations.pairs,
        )
        report.add_removal(remove(undo, self._tables, self._config))
        mark_retracted(validated.landmark_ids, self._tables.marginalised)
        present = [n for n in change.numbers if n in self._tables.pose_factors]
        self._tables.remove_pose_factors(present)
        report.lost_own += [n for n in change.own if self._tables.own_factors.pop(n, None)]
        anchor_components(self._tables, self._config)
        report.refuse_all(validated)
        try:
            self._solver.rebuild(self._tables)
        except SolverError as failure:
            logger.error("ISAM2 cannot solve the graph (%s); values stay as they were", failure)


def _check_known(table: ValueTable, ids: Ints) -> None:
    if not (known := table.contains(ids)).all():
        raise KeyError(f"not in the graph: {ids[~known].tolist()}")
