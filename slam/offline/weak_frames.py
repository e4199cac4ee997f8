"""What a run that tracked weakly says of itself: how many frames, and what most of them lack."""

from __future__ import annotations

import logging
from collections import Counter
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.frame_file import FrameTable, read_frames
from bmask_slam.tracking.results import TrackingStatus

logger = logging.getLogger(__name__)

MIN_SHARE, MIN_FRAMES = 0.25, 10
"""Of the frames, and so many: fewer WEAK ones are turns and blur, as right recordings have them."""
CONTRADICTED = "most matches contradict the pose"
FEW = "few landmarks agree with the pose"
UNCERTAIN = "the position is uncertain, few near points are in view or found again"
NEVER = (
    "tracking: no frame has a pose; a map begins where enough corners have depth: bmask-slam info "
    "says how many pixels have it, at what distance"
)
NEVER_IN_MAP = (
    "tracking: no frame was recognised in the map; give the map of this place, seen from about "
    "there, and the camera that the recording was made with"
)
CURES = {
    CONTRADICTED: (
        "either colour and depth, or the camera and its images, do not fit together (depth_scale, "
        "intrinsics, stamps, depth along the ray in place of z), or much of the view moves, or "
        "there are too few frames a second"
    ),
    FEW: "more light, a slower camera or more frames a second help",
    UNCERTAIN: "the room is far, or depth_scale is too small",
}


def weakly_tracked(path: Path, min_inliers: int, in_map: bool = False) -> tuple[str, ...]:
    """The warning that a run's frames.csv gives reason for, if any; it is logged too.

    ``min_inliers`` is what an OK frame needs; ``in_map``: frames were only located in a map.
    """
    try:
        text = weak_warning(read_frames(path), min_inliers)
    except InputError as error:
        logger.info("frames not looked at: %s", error)
        return ()
    if in_map and text == NEVER:
        text = NEVER_IN_MAP
    if not text:
        return ()
    logger.warning(text)
    return (text,)


def weak_warning(frames: FrameTable, min_inliers: int) -> str:
    """A line that says why the frames of a run are doubtful; "" where only a few are."""
    if len(frames) >= MIN_FRAMES and set(frames.status) == {TrackingStatus.LOST.value}:
        return NEVER
    reasons = Counter(
        _reason(matches, inliers, min_inliers)
        for status, matches, inliers in zip(
            frames.status, frames.matches.tolist(), frames.inliers.tolist(), strict=True
        )
        if status == TrackingStatus.WEAK.value
    )
    weak = reasons.total()
    if weak < max(MIN_FRAMES, MIN_SHARE * len(frames)):
        return ""
    reason, count = reasons.most_common(1)[0]
    return (
        f"tracking: {weak} of {len(frames)} frames are WEAK, so the path is doubtful; in {count} "
        f"of them {reason}: {CURES[reason]}"
    )


def _reason(matches: int, inliers: int, min_inliers: int) -> str:
    """Which of the conditions of docs/tracking.md a WEAK frame does not meet."""
    if 2 * inliers < matches:
        return CONTRADICTED
    return FEW if inliers < min_inliers else UNCERTAIN
