"""What one update of the smoother did that was not asked for, collected on the way."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.factors.factor_tables import FactorTables, ids_array
from bmask_slam.graph.factors.graph_estimate import (
    NO_LANDMARK,
    GraphEstimate,
    RefusalReason,
    Refusals,
    RefusedFactor,
)
from bmask_slam.graph.factors.own_factors import Variable
from bmask_slam.graph.smoother.removal import Removal
from bmask_slam.graph.smoother.repair import Repair
from bmask_slam.graph.smoother.validation import Validated


@dataclass
class UpdateReport:
    """The fields of ``GraphEstimate`` that tell of an update, while it goes on."""

    refused: Refusals = field(default_factory=Refusals)
    refused_factors: tuple[RefusedFactor, ...] = ()
    dropped_landmarks: set[int] = field(default_factory=set)
    dropped_keyframes: set[int] = field(default_factory=set)
    anchored_keyframes: set[int] = field(default_factory=set)
    lost_own: list[int] = field(default_factory=list)
    new_own: tuple[int, ...] = ()
    failed_own: list[int] = field(default_factory=list)
    rebuilt: bool = False
    failed: Variable | None = None
    started_s: float = field(default_factory=time.perf_counter)

    @property
    def failed_variable(self) -> str:
        """The variable that ISAM2 named last, in words."""
        return "" if self.failed is None else "{} {}".format(*self.failed)

    def add_removal(self, removal: Removal) -> None:
        """Note what a removal did that was not asked for."""
        self.dropped_landmarks.update(removal.dropped_landmarks.tolist())
        self.anchored_keyframes.update(removal.anchored_keyframes.tolist())

    def add_repair(self, repair: Repair) -> None:
        """Note what a repair removed and anchored."""
        self.dropped_landmarks.update(repair.dropped_landmarks.tolist())
        self.dropped_keyframes.update(repair.dropped_keyframes.tolist())
        self.anchored_keyframes.update(repair.anchored_keyframes.tolist())

    def refuse_all(self, validated: Validated) -> None:
        """Refuse everything that had passed validation, as SOLVER_FAILED."""
        observations, keyframes = validated.observations, validated.keyframe_ids
        count, reason = len(observations) + len(keyframes), RefusalReason.SOLVER_FAILED
        whole = np.full(len(keyframes), NO_LANDMARK)
        self.refused = Refusals(
            np.concatenate([self.refused.keyframe_ids, observations.keyframe_ids, keyframes]),
            np.concatenate([self.refused.landmark_ids, observations.landmark_ids, whole]),
            np.concatenate([self.refused.reasons, np.full(count, reason)]),
        )
        self.refused_factors += tuple(
            RefusedFactor(f.kind, f.keyframe_ids, reason) for f in validated.pose_factors
        )

    def estimate(self, tables: FactorTables, solver_s: float) -> GraphEstimate:
        """The values of the graph with this report."""
        return GraphEstimate(
            tables.keyframes.ids,
            tables.keyframes.values,
            tables.landmarks.ids,
            tables.landmarks.values,
            self.refused,
            self.refused_factors,
            ids_array(self.dropped_landmarks),
            ids_array(self.dropped_keyframes),
            ids_array(self.anchored_keyframes),
            lost_own_factors=tuple(self.lost_own),
            failed_own_factors=tuple(self.failed_own),
            rebuilt=self.rebuilt,
            failed_variable=self.failed_variable,
            update_ms=1e3 * (time.perf_counter() - self.started_s),
            solver_ms=1e3 * solver_s,
            factors=len(tables),
        )
