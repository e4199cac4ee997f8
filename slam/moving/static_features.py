"""A frame's features without those on moving things, and others in their place."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features, joined, select
from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import Array
from bmask_slam.moving.depth_segments import MovingSpace
from bmask_slam.moving.free_space_check import DepthView
from bmask_slam.sequences.frame import Frame

LEAST_SHARE = 0.1
"""If a smaller share of the keypoints was left out, no others are searched."""
MOST_SHARE = 0.8
"""The search is limited to that for this share of left-out keypoints."""


@dataclass(frozen=True, eq=False)
class StaticFeatures:
    """The features of a frame without those on moving things.

    Attributes:
        features: the static ones, and others in place of the rest; the frame's own where
            ``mostly_moving``.
        moving: (N,) which of the frame's own features lie on moving things.
        mostly_moving: too few would have been left, so that all are used.
        view: the frame's depth as free space and surfaces; None if geometry is switched off.
        static_count: number of features that lie where earlier views saw a surface.
        T_world_camera: (4, 4) that they were judged at; None if none was left out.
        space: where something moves in the frame; None if that is not known.
    """

    features: Features
    moving: Mask
    mostly_moving: bool
    view: DepthView | None
    static_count: int = 0
    T_world_camera: Array | None = None
    space: MovingSpace | None = None

    @property
    def ignored(self) -> int:
        """Number of features that were left out."""
        return 0 if self.mostly_moving else int(np.count_nonzero(self.moving))


class FeatureReplenishment:
    """Searches a frame for more keypoints. It holds its own detector: use one per thread."""

    def __init__(self, camera: Camera, config: FeatureConfig) -> None:
        self.extractor = BriskExtractor(camera, config)

    def replenished(
        self,
        frame: Frame,
        features: Features,
        moving: Mask,
        judge: Callable[[Features], Mask],
    ) -> Features:
        """The static features (N,), and up to as many others as are ``moving`` (N,).

        The others are what the search would have found outside the moving things, with the same
        spread, at a threshold that gives enough of them. ``judge`` returns which of them move; they
        have no descriptors at that time.
        """
        left = select(features, np.flatnonzero(~moving))
        share = moving.mean()
        if share < LEAST_SHARE:
            return left
        reserve = self.extractor.reserve(frame, features, min(share, MOST_SHARE))
        still = np.flatnonzero(~judge(reserve))[: len(features) - len(left)]
        return joined(left, self.extractor.described(select(reserve, still)))
