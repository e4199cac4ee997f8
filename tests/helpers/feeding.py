"""Tracks frames in a live system at a rate that the map process can follow."""

from __future__ import annotations

import time

from bmask_slam.live.live_slam import LiveSlam
from bmask_slam.sequences.frame import Frame
from bmask_slam.tracking.results import TrackingStatus

MAX_WAIT_S = 60


def track_frames(slam: LiveSlam, frames: list[Frame], waiting: int = 1) -> list[TrackingStatus]:
    """Track frames, each when at most ``waiting`` keyframes wait for the map; their statuses."""
    statuses = []
    for frame in frames:
        tracked = slam.track(frame.timestamp_s, frame.rgb, frame.depth_m, name="a.png")
        statuses.append(tracked.status)
        deadline_s = time.monotonic() + MAX_WAIT_S
        while slam.health().keyframes_waiting > waiting and time.monotonic() < deadline_s:
            if slam._system.remote.given_up:
                break
            time.sleep(0.01)
            slam.catch_up()
    return statuses
