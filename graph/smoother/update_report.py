"""What one update of the smoother did beyond its orders."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.graph.factors.checks import describe
from bmask_slam.graph.factors.graph_update import (
    NO_LANDMARK,
    RefusalReason,
    Refusals,
    RefusedFactor,
    RemovalReport,
)
from bmask_slam.graph.smoother.isam2 import Variable
from bmask_slam.graph.smoother.removal import Removal
from bmask_slam.graph.smoother.repair import Repair
from bmask_slam.graph.smoother.validation import Validated


@dataclass
class UpdateReport:
    """Collected on the way, and read into the estimate."""

    refused: Refusals = field(default_factory=Refusals)
    refused_factors: tuple[RefusedFactor, ...] = ()
    removal: RemovalReport = field(default_factory=RemovalReport)
    landmarks: set[int] = field(default_factory=set)
    keyframes: set[int] = field(default_factory=set)
    anchored: set[int] = field(default_factory=set)
    rebuilt: bool = False
    failed: Variable | None = None

    @property
    def failed_variable(self) -> str:
        """The variable that ISAM2 named last, in words."""
        return "" if self.failed is None else "{} {}".format(*self.failed)

    def add_removal(self, removal: Removal) -> None:
        self.landmarks.update(removal.dropped_landmarks.tolist())
        self.anchored.update(removal.anchored_keyframes.tolist())

    def refuse_all(self, validated: Validated) -> None:
        """Refuse everything that had been admitted, as SOLVER_FAILED."""
        seen, keyframes = validated.observations, validated.keyframe_ids
        nothing = np.full(len(keyframes), NO_LANDMARK)
        self.refused = Refusals(
            np.concatenate([self.refused.keyframe_ids, seen.keyframe_ids, keyframes]),
            np.concatenate([self.refused.landmark_ids, seen.landmark_ids, nothing]),
            np.concatenate(
                [
                    self.refused.reasons,
                    np.full(len(seen) + len(keyframes), RefusalReason.SOLVER_FAILED),
                ]
            ),
        )
        self.refused_factors += tuple(
            RefusedFactor(*describe(factor), RefusalReason.SOLVER_FAILED)
            for factor in validated.pose_factors
        )

    def add_repair(self, repair: Repair) -> None:
        self.landmarks.update(repair.dropped_landmarks.tolist())
        self.keyframes.update(repair.dropped_keyframes.tolist())
        self.anchored.update(repair.anchored_keyframes.tolist())
