"""Settings of tracking."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.features.matching import MatchConfig
from bmask_slam.features.patch_alignment import SubpixelConfig
from bmask_slam.tracking.image_motion import ImageMotionConfig
from bmask_slam.tracking.pose.newcomers import NewcomerConfig
from bmask_slam.tracking.pose.pose_optimisation import PoseOptimisationConfig


@dataclass(frozen=True)
class TrackingConfig:
    """Search windows in pixels, and what a frame needs for the status OK and WEAK.

    A frame is WEAK with ``weak_inliers``; it is OK with ``min_inliers`` that are at least half of
    its matches, and a position with a standard deviation of at most ``max_sigma_m``. The first
    search is for the last frame's landmarks around their predicted places; if it fails, for the
    whole local map, then with ``wide_radius_px``; the second, with ``local_radius_px``, for all.
    """

    search_radius_px: float = 20.0
    wide_radius_px: float = 60.0
    local_radius_px: float = 6.0
    min_inliers: int = 30
    weak_inliers: int = 15
    max_sigma_m: float = 0.005
    max_view_angle_deg: float = 60.0
    match: MatchConfig = field(default_factory=MatchConfig)
    pose: PoseOptimisationConfig = field(default_factory=PoseOptimisationConfig)
    subpixel: SubpixelConfig = field(default_factory=SubpixelConfig)
    image_motion: ImageMotionConfig = field(default_factory=ImageMotionConfig)
    newcomers: NewcomerConfig = field(default_factory=NewcomerConfig)
