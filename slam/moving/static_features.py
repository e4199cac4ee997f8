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
"""Of the keypoints; where fewer were left out none are looked for."""
MOST_SHARE = 0.8
"""The search is no wider than where so many were left out."""


@dataclass(frozen=True, eq=False)
class StaticFeatures:
    """A frame without what moves.

    Attributes:
        features: the static ones, and others in place of the rest; the frame's own where
            ``mostly_moving``.
        moving: (N,) which of the frame's own features lie on moving things.
        mostly_moving: too few would have been left, so that all are used.
        view: the frame's depth as free space and surfaces; None if geometry is switched off.
        standing: number of features that lie where earlier views saw a surface.
        T_world_camera: (4, 4) that they were judged at; None if none was left out.
        space: where something moves in the frame; None if that is not known.
    """

    features: Features
    moving: Mask
    mostly_moving: bool
    view: DepthView | None
    standing: int = 0
    T_world_camera: Array | None = None
    space: MovingSpace | None = None

    @property
    def ignored(self) -> int:
        """How many features were left out."""
        return 0 if self.mostly_moving else int(np.count_nonzero(self.moving))


class FeatureReplenishment:
    """Searches a frame once more; holds a detector of its own, so that it may run in any thread."""

    def __init__(self, camera: Camera, config: FeatureConfig) -> None:
        self._extractor = BriskExtractor(camera, config)

    def replenished(
        self,
        frame: Frame,
        features: Features,
        moving: Mask,
        judge: Callable[[Features], Mask],
    ) -> Features:
        """Those of features (N,) that do not move (N,), with as many others as were left out.

        The others are what the search would have found beside the moving things: at the same
        spread, at the threshold that gives enough of them. ``judge`` says which of them move; they
        have no descriptors then.
        """
        left = select(features, np.flatnonzero(~moving))
        share = moving.mean()
        if share < LEAST_SHARE:
            return left
        reserve = self._extractor.reserve(frame, features, min(share, MOST_SHARE))
        still = np.flatnonzero(~judge(reserve))[: len(features) - len(left)]
        return joined(left, self._extractor.described(select(reserve, still)))
