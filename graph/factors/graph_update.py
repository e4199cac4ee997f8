"""What goes into the smoother: observations, relative poses, priors and removals, as arrays.

Nothing here imports GTSAM, so that an update can be made, queued and sent to another process.
Ids of keyframes and landmarks are non-negative integers chosen by the caller; one id names one
thing at a time, and an id that was removed can be used again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Ints, no_ids, no_pairs
from bmask_slam.graph.inertial.tables import InertialUpdate

RelativePoseName = tuple[int, int, str]
"""keyframe_a, keyframe_b, kind."""
LOOP, MARGINAL, ANCHOR = "loop", "marginal", "bridge"
"""Kinds of relative poses: a closed loop; what stands for marginalised landmarks; a weak between
factor that the smoother adds to hold a keyframe (called a bridge in saved graphs)."""
ODOMETRY, GRAVITY, POSITION, PLANAR = "odometry", "gravity", "position", "planar"
"""Kinds of relative poses that sensors measure."""
MARKER, SITE = "marker", "site"
"""Kinds of fiducial markers: one that a keyframe sees; its known pose in the frame of a site."""
KERNELS = ("huber", "cauchy", "dcs")
"""Robust kernels of relative poses."""
PARTIAL = (GRAVITY, POSITION, PLANAR)
"""Kinds that fix a part of a pose only: what they do not measure has a very large sigma."""
FIRST_FRAME, FRAMES_OF_A_KIND = 1 << 40, 1 << 30
"""Reference frames (up is z) are poses of the graph with ids from here on, one a map segment;
planes of motion have ids that are by so much larger; markers and sites follow."""
MARKERS_OF_A_SEGMENT = 1 << 14


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

    keyframe_ids: Ints = field(default_factory=no_ids)
    landmark_ids: Ints = field(default_factory=no_ids)
    measurements: Array = field(default_factory=lambda: _zeros(0, 3))
    sigmas_px: Array = field(default_factory=lambda: _zeros(0, 3))

    def __len__(self) -> int:
        return len(self.keyframe_ids)

    @property
    def pairs(self) -> Ints:
        """Keyframe and landmark id (M, 2)."""
        return np.stack([self.keyframe_ids, self.landmark_ids], axis=1)

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
        robust: None, or one of KERNELS.
        kind: where it comes from: LOOP, "dense", what sensors measure; made by the smoother
            itself: MARGINAL, ANCHOR.
    """

    keyframe_a: int
    keyframe_b: int
    T_a_b: Array
    covariance: Array
    robust: str | None = None
    kind: str = "odometry"

    @property
    def keyframe_ids(self) -> tuple[int, int]:
        """Both ids."""
        return self.keyframe_a, self.keyframe_b

    @property
    def name(self) -> RelativePoseName:
        """What ``GraphUpdate.remove_relative_poses`` names it by."""
        return self.keyframe_a, self.keyframe_b, self.kind


def reference_frame_id(segment: int) -> int:
    """The id of a map segment's reference frame among the poses of the graph."""
    return FIRST_FRAME + segment


def plane_id(segment: int) -> int:
    """The id of the plane that a map segment's camera moves over, among the poses of the graph."""
    return FIRST_FRAME + FRAMES_OF_A_KIND + segment


def marker_id(segment: int, number: int) -> int:
    """The id of the marker ``number`` of a map segment, among the poses of the graph."""
    return FIRST_FRAME + 2 * FRAMES_OF_A_KIND + segment * MARKERS_OF_A_SEGMENT + number


def marker_of(pose_id: int) -> tuple[int, int] | None:
    """Segment and number of a marker by its id; None for another pose."""
    if not marker_id(0, 0) <= pose_id < site_id(0):
        return None
    segment, number = divmod(pose_id - marker_id(0, 0), MARKERS_OF_A_SEGMENT)
    return segment, number


def site_id(segment: int) -> int:
    """The id of the frame in which poses of markers are known, among the poses of the graph."""
    return FIRST_FRAME + 3 * FRAMES_OF_A_KIND + segment


@dataclass(frozen=True)
class PosePrior:
    """A belief about one keyframe: T_world_camera (4, 4), covariance (6, 6) ``[rad, m]``."""

    keyframe_id: int
    T_world_camera: Array
    covariance: Array
    kind: ClassVar[str] = "prior"

    @property
    def keyframe_ids(self) -> tuple[int]:
        """The one id."""
        return (self.keyframe_id,)


@dataclass(frozen=True)
class GraphUpdate:
    """One change of the graph; removals are carried out before anything is added.

    Attributes:
        keyframe_ids: (K,) new keyframes.
        poses_world_camera: (K, 4, 4) their initial values.
        landmark_ids: (L,) new landmarks.
        points_world: (L, 3) their initial values in metres.
        observations: may concern old keyframes and old landmarks too (delayed insertion).
        relative_poses, priors: more factors.
        remove_landmarks: (N,) ids; the variable and all its factors are removed.
        remove_keyframes: (N,) ids; the variable and all its factors are removed, and the
            landmarks that nothing else constrains.
        remove_observations: (N, 2) columns keyframe id, landmark id.
        remove_relative_poses: triples (keyframe_a, keyframe_b, kind).
        max_iterations: further steps that ISAM2 may take until no variable moves any more, for a
            change that moves much of the graph, such as a loop.
        marginalise_landmarks: (N,) ids; the variables are removed, and relative poses replace
            their factors. An id in ``landmark_ids`` that was marginalised comes back at the place
            that its summary gives (`graph.marginals.landmark_marginalisation`): ``points_world``
            is not read for it, and only new observations enter.
        own_factors: numbers and `graph.factors.factor_tables.OwnFactor` of a user's factors, whose
            variables are in the graph.
        remove_own_factors: numbers.
        inertial: what changes in velocities, biases and inertial factors.

    Ids to remove that are not in the graph are ignored.
    """

    keyframe_ids: Ints = field(default_factory=no_ids)
    poses_world_camera: Array = field(default_factory=lambda: _zeros(0, 4, 4))
    landmark_ids: Ints = field(default_factory=no_ids)
    points_world: Array = field(default_factory=lambda: _zeros(0, 3))
    observations: Observations = field(default_factory=Observations)
    relative_poses: tuple[RelativePose, ...] = ()
    priors: tuple[PosePrior, ...] = ()
    remove_landmarks: Ints = field(default_factory=no_ids)
    remove_keyframes: Ints = field(default_factory=no_ids)
    remove_observations: Ints = field(default_factory=no_pairs)
    remove_relative_poses: tuple[RelativePoseName, ...] = ()
    max_iterations: int = 0
    marginalise_landmarks: Ints = field(default_factory=no_ids)
    own_factors: tuple[tuple[int, Any], ...] = ()
    remove_own_factors: tuple[int, ...] = ()
    inertial: InertialUpdate = field(default_factory=InertialUpdate)
