"""Keypoints in place of those on moving things, which do not use up what a frame may have."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features, joined, select
from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.frame import Frame

LEAST_SHARE = 0.1
"""Of the keypoints; where fewer were left out none are looked for."""
MOST_SHARE = 0.8
"""The search is no wider than where so many were left out."""


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
