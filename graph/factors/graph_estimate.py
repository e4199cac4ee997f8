"""What comes out of the smoother: estimates, refused factors and errors of factors, as arrays."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints, Mask, no_ids

NO_LANDMARK = -1
"""In a column of landmark ids: the whole keyframe is meant."""


class RefusalReason(IntEnum):
    """Why the smoother refused something; the first that applies, in this order."""

    NOT_FINITE = 1
    UNKNOWN_KEYFRAME = 2
    UNKNOWN_LANDMARK = 3
    DUPLICATE = 4
    BEHIND_CAMERA = 5
    OUT_OF_RANGE = 6
    REPROJECTION = 7
    LANDMARK_UNDERCONSTRAINED = 8
    """Its landmark would have no stereo view and not two views with parallax: try again later."""
    KEYFRAME_UNDERCONSTRAINED = 9
    """Its new keyframe would share too few landmarks with the graph."""
    BAD_COVARIANCE = 10
    SOLVER_FAILED = 11
    """ISAM2 could not solve with it; the graph goes on without it."""

    @property
    def text(self) -> str:
        """In words."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True)
class Refusals:
    """Refused observations and keyframes, as columns.

    Attributes:
        keyframe_ids, landmark_ids: (N,) int64; landmark id NO_LANDMARK: the keyframe itself.
        reasons: (N,) int64 values of RefusalReason.
    """

    keyframe_ids: Ints = field(default_factory=no_ids)
    landmark_ids: Ints = field(default_factory=no_ids)
    reasons: Ints = field(default_factory=no_ids)

    def __len__(self) -> int:
        return len(self.reasons)

    def count(self, reason: RefusalReason) -> int:
        """How often this reason was given."""
        return int(np.count_nonzero(self.reasons == reason))


@dataclass(frozen=True)
class RefusedFactor:
    """A relative pose ("loop", "odometry", ...) or a prior ("prior") that was refused."""

    kind: str
    keyframe_ids: tuple[int, ...]
    reason: RefusalReason


@dataclass(frozen=True)
class GraphEstimate:
    """All values of the graph after an update, and what the smoother did that was not asked for.

    Attributes:
        keyframe_ids: (K,) sorted ids of ALL keyframes in the graph.
        poses_world_camera: (K, 4, 4) their optimised poses.
        landmark_ids: (L,) sorted ids of ALL landmarks in the graph.
        points_world: (L, 3) their optimised positions in metres.
        refused: observations and new keyframes that were refused, with reasons.
        refused_factors: relative poses and priors that were refused.
        dropped_landmarks: ids removed without being asked for: left underconstrained by a
            removal, or removed after a failure of the solver.
        dropped_keyframes: the same for keyframes.
        anchored_keyframes: old keyframes that a removal left underconstrained; each gets a weak
            between factor to a neighbour (kind ANCHOR, removed when enough other factors
            constrain it again), or, where a whole component of the graph lost its prior, a prior
            at its current estimate.
        lost_own_factors: numbers of a user's factors that were removed with one of their variables.
        failed_own_factors: the same of those that were removed after a failure of the solver.
        rebuilt: ISAM2 failed and was made anew from the factor tables.
        failed_variable: the variable it named last, such as "landmark 17"; "" if none.
        cost_before, cost_after: half the sum of (robust) squared whitened errors before and
            after a batch optimisation; NaN after an incremental update.
        update_ms: wall time of the whole update; solver_ms: of GTSAM's part of it.
        factors: number of factors in the graph now.
    """

    keyframe_ids: Ints
    poses_world_camera: Array
    landmark_ids: Ints
    points_world: Array
    refused: Refusals = field(default_factory=Refusals)
    refused_factors: tuple[RefusedFactor, ...] = ()
    dropped_landmarks: Ints = field(default_factory=no_ids)
    dropped_keyframes: Ints = field(default_factory=no_ids)
    anchored_keyframes: Ints = field(default_factory=no_ids)
    lost_own_factors: tuple[int, ...] = ()
    failed_own_factors: tuple[int, ...] = ()
    rebuilt: bool = False
    failed_variable: str = ""
    cost_before: float = math.nan
    cost_after: float = math.nan
    update_ms: float = 0.0
    solver_ms: float = 0.0
    factors: int = 0

    def counts(self) -> dict[str, int]:
        """How much was refused, dropped, anchored or repaired, by words and reason."""
        whole = self.refused.landmark_ids == NO_LANDMARK
        reasons: Counter[tuple[str, int]] = Counter()
        for what, rows in (("observations refused: ", ~whole), ("keyframes refused: ", whole)):
            reasons.update((what, reason) for reason in self.refused.reasons[rows].tolist())
        for factor in self.refused_factors:
            reasons[f"factors refused: {factor.kind}, ", int(factor.reason)] += 1
        counts = {
            f"{what}{RefusalReason(reason).text}": count
            for (what, reason), count in sorted(reasons.items())
        }
        counts["landmarks dropped"] = len(self.dropped_landmarks)
        counts["keyframes dropped"] = len(self.dropped_keyframes)
        counts["keyframes anchored"] = len(self.anchored_keyframes)
        counts["rebuilds"] = int(self.rebuilt)
        return {what: count for what, count in counts.items() if count}

    def notes(self) -> list[str]:
        """One line for each kind of thing that was refused, dropped, anchored or repaired."""
        counts = self.counts()
        rebuilt = counts.pop("rebuilds", 0)
        lines = [f"{count} {what}" for what, count in counts.items()]
        lines += [f"own factor {n} was removed with its variable" for n in self.lost_own_factors]
        failed = self.failed_own_factors
        lines += [f"own factor {n} was removed: the graph could not be solved" for n in failed]
        if rebuilt:
            lines.append(f"rebuilt after a failure near {self.failed_variable or 'no variable'}")
        return lines


@dataclass(frozen=True)
class ObservationErrors:
    """How well each observation in the graph fits the current estimate.

    Attributes:
        keyframe_ids, landmark_ids: (M,) int64, ordered by keyframe, then landmark.
        chi2: (M,) squared whitened reprojection errors WITHOUT any robust kernel; compare
            with 7.815 (stereo, 3 degrees of freedom) or 5.991 (monocular, 2) at 95 %.
        depth_m: (M,) z-depth of the landmark in the keyframe's camera, in metres.
        is_stereo: (M,) bool.
    """

    keyframe_ids: Ints
    landmark_ids: Ints
    chi2: Array
    depth_m: Array
    is_stereo: Mask


@dataclass(frozen=True)
class RelativePoseErrors:
    """How well each relative pose in the graph fits the current estimate, in insertion order.

    Attributes:
        keyframe_a, keyframe_b: (N,) int64.
        kinds: (N,) str, as in RelativePose.
        chi2: (N,) squared whitened errors WITHOUT any robust kernel, 6 degrees of freedom.
    """

    keyframe_a: Ints
    keyframe_b: Ints
    kinds: NDArray[np.str_]
    chi2: Array
