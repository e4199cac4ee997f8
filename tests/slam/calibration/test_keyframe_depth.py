"""Depth images around a keyframe of a live run: rates of change, and the delay that they undo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bmask_slam.calibration.keyframe_depth import (
    DepthImage,
    KeptDepths,
    KeyframeDepth,
    KeyframeImages,
)
from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.images import depth_in_metres

SPEED = 0.4  # m/s, a wall that goes away
STEP_S, LAG_S, OFFSET_S = 1 / 30, 0.004, -0.015
COLOUR = np.zeros((0, 320, 3), np.uint8)
PIXELS = np.array([[100.0, 80.0], [160.3, 120.7], [220.0, 150.0]])


def wall_m(time_s: float) -> np.ndarray:
    """A wall in front of the camera; inverse depth is linear in the pixels."""
    columns = np.broadcast_to(np.arange(320.0), (240, 320))
    return (1 / (0.5 + 2e-4 * columns) + SPEED * time_s).astype(np.float32)


def images(colour_s: float = 10.0) -> KeyframeImages:
    """Depth with a lag by its stamps, taken OFFSET_S from its stamps."""
    taken = [colour_s + LAG_S + k * STEP_S for k in (0, -1, 1)]
    around = [DepthImage(wall_m(t + OFFSET_S - colour_s), t) for t in taken]
    return KeyframeImages(3, COLOUR, PIXELS, *around, LAG_S)


def test_the_depth_at_the_colour_images_time_is_found_by_the_rate() -> None:
    depth, sigmas = KeyframeDepth.of(images()), np.full(3, 0.002)
    samples = depth.sample(PIXELS, sigmas)
    inverse = 0.5 + 2e-4 * PIXELS[:, 0]
    np.testing.assert_allclose(samples.rate, -SPEED * inverse**2, rtol=0.03)
    corrected = samples.inverse_depth + depth.delay_correction(np.arange(3), sigmas, OFFSET_S)
    np.testing.assert_allclose(corrected, inverse, atol=3e-4)
    assert np.abs(samples.inverse_depth - inverse).min() > 8e-4


@pytest.mark.parametrize("fault", ["surface", "time"])
def test_an_unknown_rate_corrects_nothing(fault: str) -> None:
    given = images()
    later = replace(given.after, depth_m=given.after.depth_m + 1)  # another surface
    if fault == "time":
        later = replace(given.after, stamp_s=given.after.stamp_s + 1)
    depth, sigmas = KeyframeDepth.of(replace(given, after=later)), np.full(3, 0.002)
    samples = depth.sample(PIXELS, sigmas)
    assert np.isnan(samples.rate).all() and np.isfinite(samples.inverse_depth).all()
    assert not depth.delay_correction(np.arange(3), sigmas, OFFSET_S).any()


def test_kept_depths_are_the_raw_ones() -> None:
    """What the camera's offset and distortion did to depth and its rate is undone."""
    bend = (0.004, -0.006, 0.010, 0.014, -0.005)
    camera = Camera(320, 240, 260.0, 260.0, 160.0, 120.0, depth_scale=1.0)
    bent = replace(camera, depth_offset_m=0.03, depth_distortion=bend)
    raw = images()
    corrected = (
        DepthImage(depth_in_metres(image.depth_m, bent), image.stamp_s)
        for image in (raw.depth, raw.before, raw.after)
    )
    kept = KeyframeDepth.of(KeyframeImages(3, COLOUR, PIXELS, *corrected, LAG_S))
    sigmas = np.full(3, 0.002)
    found = KeptDepths({3: kept}, bent).measure(3, PIXELS, sigmas)
    truth = KeyframeDepth.of(raw).sample(PIXELS, sigmas)
    assert np.abs(kept.sample(PIXELS, sigmas).inverse_depth - truth.inverse_depth).min() > 5e-3
    np.testing.assert_allclose(found.inverse_depth, truth.inverse_depth, atol=2e-4)
    np.testing.assert_allclose(found.rate, truth.rate, rtol=5e-3)
    assert (found.lag_s == LAG_S).all()
