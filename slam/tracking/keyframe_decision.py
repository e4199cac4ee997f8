"""When a frame becomes a keyframe, and why (Algorithm 2 of the paper and its origin)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.tracking.camera_tracker import CameraTracker
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapReader

CLOSE_BASELINES = 40
"""A point is close within so many baselines (ORB-SLAM2, section III.A)."""
STARVING = "close points run out"
"""Why a frame becomes a keyframe by ORB-SLAM2's extra rule."""


@dataclass(frozen=True)
class KeyframeConfig:
    """Parameters of the decision; ``rule`` is "orb" (default) or "paper".

    "orb" (ORB-SLAM, section V.E, with ORB-SLAM2's extra rule): mapping is idle or more than
    ``max_interval_frames`` have passed, at least ``min_tracked`` points are tracked, and the
    shared view is below ``max_shared`` or, ``late_frames`` after the last keyframe, below
    ``late_shared``; or the close points run out: fewer than ``min_close_tracked`` are tracked
    while ``min_close_new`` could be made. ORB-SLAM's 90 % counts only points that three keyframes
    see; here those of the reference keyframe's points count that are found in at least
    ``mapping.min_found_ratio`` of the frames that should show them, so that 0.55 is the equivalent.
    In a room that is seen again more points are in view than a frame has keypoints; if those that
    are found rarely counted too, a known view would look like a new one. In front of a flat wall a
    slow camera keeps half of its points for seconds, and only new points show the motion along the
    wall; hence ``late_shared``. In a fast turn a view is gone within three frames: below
    ``urgent_shared`` neither ``min_interval_frames`` nor mapping is waited for, so that there are
    landmarks enough to place the keyframe. The reference keyframe is the last one. If another
    keyframe shares more with a frame that is to become a keyframe, and at least ``known_shared``
    of its points, that one becomes the reference, and the next frame is decided against it: a
    known view needs no new keyframe. Nor do close points that run out where a keyframe from
    ``known_after_s`` before shares ``max_shared`` of its points: those that could be made were
    made then, and are not found again. With ``max_shared`` of 1 or more these rules are off.
    "paper" (Algorithm 2 as printed): at least ``paper_interval_frames`` since the last keyframe AND
    mapping idle AND less than ``paper_shared`` shared AND at least ``paper_min_matches`` matches.
    """

    rule: Literal["orb", "paper"] = "orb"
    min_interval_frames: int = 3
    max_interval_frames: int = 20
    min_tracked: int = 50
    max_shared: float = 0.55
    late_frames: int = 10
    late_shared: float = 0.65
    urgent_shared: float = 0.45
    known_shared: float = 0.25
    known_after_s: float = 20.0
    min_close_tracked: int = 100
    min_close_new: int = 70
    paper_interval_frames: int = 30
    paper_shared: float = 0.9
    paper_min_matches: int = 100


@dataclass(frozen=True)
class KeyframeEvidence:
    """The quantities that the rule compares.

    Attributes:
        frames_since: frames since the last keyframe was made.
        mapping_idle: the back end waits for work; True in an offline run, so that runs repeat.
        tracked: landmarks tracked in this frame.
        shared: tracked points over the points of the reference keyframe that are often found.
        close_tracked: tracked landmarks at close range.
        close_new: keypoints at close range that are not tracked.
    """

    frames_since: int
    mapping_idle: bool
    tracked: int
    shared: float
    close_tracked: int
    close_new: int


class KeyframeDecision:
    """Decides which tracked frames become keyframes.

    Attributes:
        frames_since: frames since the last keyframe was made.
    """

    def __init__(
        self,
        camera: Camera,
        config: KeyframeConfig,
        map_reader: MapReader,
        camera_tracker: CameraTracker,
        min_found_ratio: float,
    ) -> None:
        self.config = config
        self._min_found_ratio = min_found_ratio
        self.frames_since = 0
        self._close_m = CLOSE_BASELINES * camera.baseline_m
        self._map = map_reader
        self._camera_tracker = camera_tracker

    def decide(self, tracked: Tracked) -> str:
        """Why a tracked frame becomes a keyframe, "" if it does not.

        Counts the frame; one that an earlier keyframe shows as well refers to that from now on.
        """
        reference = self._camera_tracker.reference
        if not tracked.status.by_image:
            return "dead reckoning" if self._camera_tracker.goes_on(tracked) else ""
        if reference is None:
            return "first frame" if self._camera_tracker.segment == 0 else "new segment"
        self.frames_since += 1
        if not self._map.accepts_keyframes:
            return ""
        reason = keyframe_reason(self._evidence(tracked, reference), self.config)
        known = bool(reason) and self._is_known_view(tracked.landmark_ids, reference, reason)
        return "" if known else reason

    def made(self) -> None:
        """A keyframe was made; frames are counted anew."""
        self.frames_since = 0

    def _evidence(self, tracked: Tracked, reference: Keyframe) -> KeyframeEvidence:
        close = tracked.features.depth_m < self._close_m
        close_tracked = int(close[tracked.keypoints].sum())
        return KeyframeEvidence(
            frames_since=self.frames_since,
            mapping_idle=self._map.idle,
            tracked=len(tracked.landmark_ids),
            shared=len(tracked.landmark_ids) / max(self._often_found(reference), 1),
            close_tracked=close_tracked,
            close_new=int(close.sum()) - close_tracked,
        )

    def _is_known_view(self, landmark_ids: Ints, reference: Keyframe, reason: str) -> bool:
        """Whether another keyframe shows most of these landmarks; that becomes the reference.

        If close points run out: whether an old one, or the reference itself if it is old, does.
        """
        if self.config.max_shared >= 1:
            return False
        strong = self._map.world.covisible(landmark_ids, 1)
        if reason == STARVING and self._is_revisited(strong):
            return True
        if not strong or strong[0][1] is reference:
            return False
        shared, other = strong[0]
        if shared < self.config.known_shared * self._often_found(other):
            return False
        self._camera_tracker.refer_to(other)
        return True

    def _is_revisited(self, strong: list[tuple[int, Keyframe]]) -> bool:
        """Whether an old keyframe shares ``max_shared`` of its points."""
        now_s, after_s = self._camera_tracker.timestamp_s, self.config.known_after_s
        return any(
            abs(now_s - keyframe.timestamp_s) >= after_s
            and shared >= self.config.max_shared * self._often_found(keyframe)
            for shared, keyframe in strong
        )

    def _often_found(self, keyframe: Keyframe) -> int:
        """How many of the landmarks that a keyframe observes are found often enough to count."""
        world = self._map.world
        _, ids = world.observed(keyframe)
        return len(ids) - int(world.landmarks.rarely_found(ids, self._min_found_ratio).sum())


def keyframe_reason(evidence: KeyframeEvidence, config: KeyframeConfig) -> str:
    """Why this frame should become a keyframe, or "" if it should not."""
    if config.rule == "paper":
        return _paper_reason(evidence, config)
    urgent = evidence.shared < config.urgent_shared
    if evidence.frames_since < config.min_interval_frames and not urgent:
        return ""
    starving = (
        evidence.close_tracked < config.min_close_tracked
        and evidence.close_new > config.min_close_new
    )
    if starving:
        return STARVING
    overdue = evidence.frames_since > config.max_interval_frames
    ready = evidence.mapping_idle or overdue or urgent
    late = evidence.frames_since >= config.late_frames
    most = max(config.late_shared, config.max_shared) if late else config.max_shared
    if ready and evidence.tracked >= config.min_tracked and evidence.shared < most:
        return "new view"
    return ""


def _paper_reason(evidence: KeyframeEvidence, config: KeyframeConfig) -> str:
    due = (
        evidence.frames_since >= config.paper_interval_frames
        and evidence.mapping_idle
        and evidence.shared < config.paper_shared
        and evidence.tracked >= config.paper_min_matches
    )
    return "Algorithm 2" if due else ""
