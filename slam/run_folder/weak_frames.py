"""What a run that tracked weakly says of itself: how many frames, and what most of them lack."""

from __future__ import annotations

from collections import Counter

from bmask_slam.run_folder.frame_file import FrameTable
from bmask_slam.tracking.results import TrackingStatus

MIN_SHARE, MIN_FRAMES = 0.25, 10
"""Of the frames, and so many: fewer WEAK ones are turns and blur, as right recordings have them."""
CONTRADICTED = "most matches contradict the pose"
FEW = "few landmarks agree with the pose"
UNCERTAIN = "the position is uncertain, few near points are in view or found again"
CURES = {
    CONTRADICTED: (
        "either colour and depth, or the camera and its images, do not fit together (depth_scale, "
        "intrinsics, stamps, depth along the ray in place of z), or much of the view moves, or "
        "there are too few frames a second"
    ),
    FEW: "more light, a slower camera or more frames a second help",
    UNCERTAIN: "the room is far, or depth_scale is too small",
}


def weak_warning(frames: FrameTable, min_inliers: int) -> str:
    """A line that says why the frames of a run are doubtful; "" where only a few are."""
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
