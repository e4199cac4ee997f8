"""If keypoints on one side are excluded, as many are added on the other side."""

from __future__ import annotations

import numpy as np
from synthetic_view import CAMERA, render_plane

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features
from bmask_slam.graph.arrays import Mask
from bmask_slam.moving.static_features import FeatureReplenishment

CONFIG = FeatureConfig(max_keypoints=300)
FRAME = render_plane(np.eye(4))
FEATURES = BriskExtractor(CAMERA, CONFIG).extract(FRAME)


def left_of(u_px: float, features: Features) -> Mask:
    return np.asarray(features.image_pixels[:, 0] < u_px)


def filled(u_px: float) -> Features:
    moving = left_of(u_px, FEATURES)
    replenishment = FeatureReplenishment(CAMERA, CONFIG)
    return replenishment.replenished(FRAME, FEATURES, moving, lambda others: left_of(u_px, others))


def test_excluded_keypoints_are_replenished() -> None:
    found = filled(280)
    kept = FEATURES.image_pixels[~left_of(280, FEATURES)]
    assert len(kept) < 0.7 * len(FEATURES)
    assert len(found) == len(FEATURES)
    assert not left_of(280, found).any()
    np.testing.assert_array_equal(found.image_pixels[: len(kept)], kept)
    places = np.column_stack([found.image_pixels, found.scales])
    assert len(np.unique(places, axis=0)) == len(found)
    assert (np.bitwise_count(found.descriptors).sum(axis=1) > 50).all()
    columns = np.histogram(found.image_pixels[:, 0], bins=5, range=(280, 620))[0]
    assert columns.min() > 0.5 * columns.max()


def test_few_excluded_keypoints_are_not_replenished() -> None:
    found = filled(40)
    kept = ~left_of(40, FEATURES)
    assert 0.9 * len(FEATURES) < kept.sum() < len(FEATURES)
    np.testing.assert_array_equal(found.descriptors, FEATURES.descriptors[kept])
