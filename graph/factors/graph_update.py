"""What goes into the smoother and what comes out: numpy and dataclasses alone, picklable.

Nothing here imports GTSAM, so that an update can be made, queued and sent to another process.
Ids of keyframes and landmarks are non-negative integers chosen by the caller; one id names one
thing at a time, and an id that was removed can be used again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints, Mask

RelativePoseName = tuple[int, int, str]
"""keyframe_a, keyframe_b, kind."""
NO_LANDMARK = -1
"""Stands in a column of landmark ids where a whole keyframe is meant."""
NO_KEYFRAME = -1
"""Stands in a column of keyframe ids where a whole landmark is meant."""


class RefusalReason(IntEnum):
    """Why the smoother left something out; the first that applies, in this order."""

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
    """Its new keyframe would hang on too few landmarks that the graph knows."""
    BAD_COVARIANCE = 10
    SOLVER_FAILED = 11
    """ISAM2 could not solve with it; the graph goes on without it."""
    PART_UNFIXED = 12
    """A removal would take the last prior of the part of the graph that this keyframe is in."""


class RemovalPolicy(Enum):
    """What to do if a removal would leave something underconstrained."""

    DROP = "drop"
    """Carry it out: landmarks go with it, keyframes are held where they are (see pruning)."""
    REFUSE = "refuse"
    """Carry out nothing of the update's removals, and name each such variable."""


def _no_ids() -> Ints:
    return np.zeros(0, np.int64)


def _zeros(*shape: int) -> Array:
    return np.zeros(shape)


@dataclass(frozen=True)
class Observations:
    """Measurements of landmarks in keyframes, as columns.

    Attributes:
        keyframe_ids: (M,) int64.
        landmark_ids: (M,) int64.
        measurements: (M, 3) ``(u_left, v, u_right)`` in undistorted pixels, the order of
            ``Camera.project_stereo``; u_right NaN where there is no depth (monocular).
        sigmas_px: (M, 3) standard deviations in pixels of u_left, v and the DISPARITY
            u_left - u_right, which err independently; the third is not read where u_right is
            NaN.
    """

    keyframe_ids: Ints = field(default_factory=_no_ids)
    landmark_ids: Ints = field(default_factory=_no_ids)
    measurements: Array = field(default_factory=lambda: _zeros(0, 3))
    sigmas_px: Array = field(default_factory=lambda: _zeros(0, 3))

    def __len__(self) -> int:
        return len(self.keyframe_ids)

    def select(self, rows: NDArray[np.generic]) -> Observations:
        """The observations at these rows (indices or a mask)."""
        return Observations(
            self.keyframe_ids[rows],
            self.landmark_ids[rows],
            self.measurements[rows],
            self.sigmas_px[rows],
        )


def concatenate(parts: Sequence[Observations]) -> Observations:
    """One table of several."""
    if not parts:
        return Observations()
    return Observations(
        *(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Observations))
    )


@dataclass(frozen=True)
class RelativePose:
    """A measured pose of keyframe b in the frame of keyframe a.

    Attributes:
        keyframe_a, keyframe_b: the two ids.
        T_a_b: (4, 4) measurement, ``p_a = T_a_b @ p_b``.
        covariance: (6, 6) of the tangent ``[rotation rad, translation m]`` at b (right side).
        robust: None, "huber", "cauchy" or "dcs".
        kind: where it comes from: "odometry", "loop", "dense"; made by the smoother: "bridge",
            "marginal" (stands for retired landmarks).
    """

    keyframe_a: int
    keyframe_b: int
    T_a_b: Array
    covariance: Array
    robust: str | None = None
    kind: str = "odometry"


@dataclass(frozen=True)
class PosePrior:
    """A belief about one keyframe: T_world_camera (4, 4), covariance (6, 6) ``[rad, m]``."""

    keyframe_id: int
    T_world_camera: Array
    covariance: Array


@dataclass(frozen=True)
class GraphUpdate:
    """One change of the graph; what is removed is removed before anything is added.

    Attributes:
        keyframe_ids: (K,) new keyframes.
        poses_world_camera: (K, 4, 4) their initial values.
        landmark_ids: (L,) new landmarks.
        points_world: (L, 3) their initial values in metres.
        observations: may concern old keyframes and old landmarks too (delayed insertion).
        relative_poses, priors: more factors.
        remove_landmarks: (N,) ids; every factor and the variable go.
        remove_keyframes: (N,) ids; every factor and the variable go, and the landmarks that
            nothing else constrains.
        remove_observations: (N, 2) columns keyframe id, landmark id.
        remove_relative_poses: triples (keyframe_a, keyframe_b, kind).
        removal_policy: for what the removals, taken together, leave underconstrained.
        max_iterations: further steps that ISAM2 may take until nothing moves any more, for a
            change that moves much of the graph, such as a loop.
        retire_landmarks: (N,) ids; the variables go, and relative poses take over what their
            factors said of the keyframes. An id in ``landmark_ids`` that was retired comes
            back (`graph.marginals.landmark_marginalisation` states the rule), where its keyframe
            carries it:
            ``points_world`` is not read for it, and only new observations enter.

    Ids to remove that the graph does not hold are passed over.
    """

    keyframe_ids: Ints = field(default_factory=_no_ids)
    poses_world_camera: Array = field(default_factory=lambda: _zeros(0, 4, 4))
    landmark_ids: Ints = field(default_factory=_no_ids)
    points_world: Array = field(default_factory=lambda: _zeros(0, 3))
    observations: Observations = field(default_factory=Observations)
    relative_poses: tuple[RelativePose, ...] = ()
    priors: tuple[PosePrior, ...] = ()
    remove_landmarks: Ints = field(default_factory=_no_ids)
    remove_keyframes: Ints = field(default_factory=_no_ids)
    remove_observations: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    remove_relative_poses: tuple[RelativePoseName, ...] = ()
    removal_policy: RemovalPolicy = RemovalPolicy.DROP
    max_iterations: int = 0
    marginalise_landmarks: Ints = field(default_factory=_no_ids)


@dataclass(frozen=True)
class Refusals:
    """What was left out, as columns; landmark id NO_LANDMARK: the keyframe itself.

    Attributes:
        keyframe_ids, landmark_ids: (N,) int64.
        reasons: (N,) int64 values of RefusalReason.
    """

    keyframe_ids: Ints = field(default_factory=_no_ids)
    landmark_ids: Ints = field(default_factory=_no_ids)
    reasons: Ints = field(default_factory=_no_ids)

    def __len__(self) -> int:
        return len(self.reasons)

    def count(self, reason: RefusalReason) -> int:
        """How often this reason was given."""
        return int(np.count_nonzero(self.reasons == reason))


@dataclass(frozen=True)
class RefusedFactor:
    """A relative pose ("loop", "odometry", ...) or a prior ("prior") that was left out."""

    kind: str
    keyframe_ids: tuple[int, ...]
    reason: RefusalReason


@dataclass(frozen=True)
class RemovalReport:
    """What became of an update's removals; what followed from them is in the estimate.

    Attributes:
        landmark_ids, keyframe_ids: (N,) sorted ids that went as asked.
        observations: (N, 2) keyframe id, landmark id of the single observations that went.
        relative_poses: those that went by their names.
        refused: under RemovalPolicy.REFUSE the variables that the removal would have left
            underconstrained, a landmark with NO_KEYFRAME, a keyframe with NO_LANDMARK; if
            there is any, nothing went.
    """

    landmark_ids: Ints = field(default_factory=_no_ids)
    keyframe_ids: Ints = field(default_factory=_no_ids)
    observations: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    relative_poses: tuple[RelativePoseName, ...] = ()
    refused: Refusals = field(default_factory=Refusals)


@dataclass(frozen=True)
class GraphEstimate:
    """Everything in the graph after an update, and what the smoother did beyond its orders.

    Attributes:
        keyframe_ids: (K,) sorted ids of ALL keyframes in the graph.
        poses_world_camera: (K, 4, 4) their optimised poses.
        landmark_ids: (L,) sorted ids of ALL landmarks in the graph.
        points_world: (L, 3) their optimised positions in metres.
        refused: observations and new keyframes left out, with reasons.
        refused_factors: relative poses and priors left out.
        removal: what went as asked, or why not.
        dropped_landmarks: ids that went without being asked for: left underconstrained by a
            removal, or thrown out after a failure of the solver.
        dropped_keyframes: the same for keyframes.
        bridged_keyframes: old keyframes that a removal left with too little; each is held by a
            loose relative pose to a neighbour (kind "bridge", which goes when enough other
            factors hold it again), or, where a whole part of the graph lost its prior, by a
            prior at its current estimate.
        rebuilt: ISAM2 failed and was made anew from the shadow.
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
    removal: RemovalReport = field(default_factory=RemovalReport)
    dropped_landmarks: Ints = field(default_factory=_no_ids)
    dropped_keyframes: Ints = field(default_factory=_no_ids)
    anchored_keyframes: Ints = field(default_factory=_no_ids)
    rebuilt: bool = False
    failed_variable: str = ""
    cost_before: float = math.nan
    cost_after: float = math.nan
    update_ms: float = 0.0
    solver_ms: float = 0.0
    factors: int = 0


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
