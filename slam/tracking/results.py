"""What tracking and the system return for a frame: values with a status, never exceptions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from bmask_slam.events import Event
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints, no_ids
from bmask_slam.graph.sensors.odometry import Motion


class TrackingStatus(Enum):
    """OK: a pose. WEAK: an uncertain one: few or contradictory matches, far points. LOST: none.

    DEAD_RECKONING: a pose by odometry alone, since the image gives none.
    """

    OK = "OK"
    WEAK = "WEAK"
    LOST = "LOST"
    DEAD_RECKONING = "DEAD_RECKONING"

    @property
    def by_image(self) -> bool:
        """Whether the image gave the pose."""
        return self in (TrackingStatus.OK, TrackingStatus.WEAK)


@dataclass(frozen=True)
class Tracked:
    """A frame that was tracked against the map.

    Attributes:
        status: LOST means that the pose must not be used.
        T_world_camera: (4, 4).
        features: the frame's, with the registered pixels of the matches, and pixel sigmas that
            agree with the frame's residuals.
        keypoints, landmark_ids: (M,) inlier matches.
        matches: number of matches before the robust estimate.
        visible_ids: landmarks of the local map that project into the frame.
        information: (6, 6) of the pose.
        flow_only: those of the landmarks that rest on the flow of the image alone.
        moving_ids: new landmarks that have moved against older ones, see `tracking.pose.newcomers`.
        new_ids: (N,) the landmark that tracking has made of each keypoint ahead of the map, -1 for
            none; of no keypoint if it makes none ahead.
    """

    status: TrackingStatus
    T_world_camera: Array
    features: Features
    keypoints: Ints
    landmark_ids: Ints
    matches: int
    visible_ids: Ints
    information: Array
    flow_only: Ints = field(default_factory=no_ids)
    moving_ids: Ints = field(default_factory=no_ids)
    new_ids: Ints = field(default_factory=no_ids)

    @property
    def by_appearance(self) -> int:
        """How many landmarks were found by descriptor or patch, not by flow alone."""
        return len(self.landmark_ids) - len(self.flow_only)

    @property
    def landmark_of(self) -> Ints:
        """(N,) the landmark that each of the features observes, -1 for none."""
        column = np.full(len(self.features), -1, np.int64)
        column[self.keypoints] = self.landmark_ids
        return column


def lost(T_world_camera: Array, features: Features, matches: int = 0) -> Tracked:
    """A frame that has no pose; T_world_camera (4, 4) is where it was expected."""
    blank = starting(T_world_camera, features)
    return replace(blank, status=TrackingStatus.LOST, matches=matches)


def best(first: Tracked, second: Tracked, enough: int) -> Tracked:
    """The result with ``enough`` landmarks by appearance, then with more of all; else the first."""
    found = [(r.by_appearance >= enough, len(r.landmark_ids)) for r in (first, second)]
    return second if found[1] > found[0] else first


def starting(T_world_camera: Array, features: Features) -> Tracked:
    """A frame that begins a map at a given pose (4, 4)."""
    none = np.zeros(0, np.int64)
    information = np.zeros((6, 6))
    return Tracked(TrackingStatus.OK, T_world_camera, features, none, none, 0, none, information)


def reckoned(tracked: Tracked, T_world_camera: Array, motion: Motion) -> Tracked:
    """A frame that was lost, at the pose (4, 4) where a motion by odometry has led."""
    blank = starting(T_world_camera, tracked.features)
    status = TrackingStatus.DEAD_RECKONING
    information: Array = np.asarray(np.linalg.inv(motion.covariance), float)
    return replace(blank, status=status, matches=tracked.matches, information=information)


@dataclass(frozen=True, eq=False)
class Velocity:
    """A camera's velocity in its own frame.

    Attributes:
        twist: (6,) [rad/s, m/s].
        covariance: (6, 6) of it.
    """

    twist: Array
    covariance: Array


@dataclass(frozen=True)
class FrameResult:
    """The outcome of one frame.

    Attributes:
        index: the frame's position in the sequence.
        timestamp_s: its stamp in seconds.
        status: see TrackingStatus.
        T_world_camera: (4, 4) pose at the moment of tracking, None when LOST; live it is filtered
            by the camera's inertia (`PoseFilter`), unless ``smooth_trajectory`` is off. The final
            trajectory is composed at the end from the optimised keyframes.
        segment: number of the map segment, from 0; a new one starts after tracking was lost
            until the old one is recognised.
        matches: landmarks matched in the frame before the robust pose estimate.
        inliers: those that agree with the pose.
        ignored: features on moving things, which were not used.
        mostly_moving: too few features would have been left, so that all were used.
        information: (6, 6) of the pose if the map is taken as exact, in the camera's tangent
            [rotation rad, translation m]; None without a pose, and where a frame begins a map. In
            DEAD_RECKONING that of the motion since the image last gave a pose.
        keyframe_id: id of the keyframe made from this frame, or None.
        keyframe_reason: why it was made ("" when it was not).
        stage_ms: wall time of each stage in milliseconds, by name.
        events: what happened since the result before; live, also what other processes sent.
        velocity: of the camera, where the pose is filtered and frames before it tell.
    """

    index: int
    timestamp_s: float
    status: TrackingStatus
    T_world_camera: Array | None
    segment: int = 0
    matches: int = 0
    inliers: int = 0
    ignored: int = 0
    mostly_moving: bool = False
    information: Array | None = None
    keyframe_id: int | None = None
    keyframe_reason: str = ""
    stage_ms: dict[str, float] = field(default_factory=dict)
    events: tuple[Event, ...] = ()
    velocity: Velocity | None = None

    @property
    def covariance(self) -> Array | None:
        """(6, 6) of the pose against the map, ``[rad, m]`` on the right side; None without one."""
        if self.information is None:
            return None
        return np.asarray(np.linalg.inv(self.information), float)
