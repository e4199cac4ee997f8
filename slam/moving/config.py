"""Settings of the moving-object filter."""

from __future__ import annotations

from dataclasses import dataclass, field

from bmask_slam.moving.depth_segments import DepthSegmentConfig
from bmask_slam.moving.free_space_check import FreeSpaceCheckConfig
from bmask_slam.moving.static_verification import StaticVerificationConfig
from bmask_slam.semantics.beliefs.movability import MovabilityConfig
from bmask_slam.semantics.tracks.instance_tracks import TrackConfig


@dataclass(frozen=True)
class MovingObjectConfig:
    """Which evidence of motion is used: ``labels`` of masks, ``geometry`` of depth images.

    ``priors`` is a YAML file of P(moving) by class, or the name of one in ``data/labels``. If fewer
    than ``min_static`` static keypoints are left, all are used, and the frame result says so. If
    more than ``doubt_share`` of the keypoints seem to move, and fewer than ``settled_share`` lie
    where a surface was observed, the predicted pose is checked by tracking with all of them. Masks
    of moving objects are widened by ``mask_border_px``. An instance is judged only with at least
    ``min_judged`` pixels.
    """

    labels: bool = True
    geometry: bool = True
    priors: str = "movability"
    doubt_share: float = 0.5
    settled_share: float = 0.2
    min_static: int = 60
    mask_border_px: int = 5
    min_judged: int = 20
    movability: MovabilityConfig = field(default_factory=MovabilityConfig)
    check: FreeSpaceCheckConfig = field(default_factory=FreeSpaceCheckConfig)
    regions: DepthSegmentConfig = field(default_factory=DepthSegmentConfig)
    tracks: TrackConfig = field(default_factory=TrackConfig)
    static_verification: StaticVerificationConfig = field(default_factory=StaticVerificationConfig)

    def __post_init__(self) -> None:
        if self.min_static < 0 or self.mask_border_px < 0 or self.min_judged < 1:
            raise ValueError(
                "min_static and mask_border_px must not be negative, min_judged at least 1"
            )
