"""Depth from stored values, and between two depth images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.sequences.images import depth_between, depth_in_metres, filled_depth


def test_the_distortion_of_depth_is_taken_from_the_inverse_depth() -> None:
    """At the right edge x = 1 - 1/640 and y = 0 but for half a pixel."""
    camera = Camera(
        640, 480, 525.0, 525.0, 319.5, 239.5, depth_scale=1000.0, depth_offset_m=0.5,
        depth_distortion=(0.02, 0.5, 0.03, 0.0, 0.0),
    )  # fmt: skip
    stored = np.full((480, 640), 1500, np.uint16)
    stored[0, 0] = 0
    depth_m = depth_in_metres(stored, camera)
    x, y = 639 / 640, 1 / 640
    expected_m = 1 / (1 / 2.0 - (0.02 * x + 0.5 * y + 0.03 * x * x))
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m[240, 639], expected_m, rtol=1e-6)
    assert np.isnan(depth_m[0, 0])
    far = replace(camera, depth_distortion=(0.0, 0.0, 0.6, 0.0, 0.0))  # behind infinity
    assert np.isnan(depth_in_metres(stored, far)[240, 639])


def test_a_plane_that_moves_is_between_its_depths() -> None:
    u = np.arange(8, dtype=np.float32)
    inverse = [0.5 + 0.01 * u, 0.52 + 0.01 * u]  # the plane's inverse depth, linear in u and t
    near_m, other_m = (np.float32(1)[None] / i[None].astype(np.float32) for i in inverse)
    between = depth_between(near_m, other_m, 0.25)
    np.testing.assert_allclose(between, 1 / (0.505 + 0.01 * u)[None], rtol=1e-6)


def test_where_the_surface_changes_the_depth_is_not_known() -> None:
    near_m = np.array([[1.0, 1.0, np.nan, 1.0]], np.float32)
    other_m = np.array([[3.0, np.nan, 1.0, 1.001]], np.float32)
    between = depth_between(near_m, other_m, 0.4)
    np.testing.assert_allclose(between, [[np.nan, 1.0, np.nan, 1.0004]], atol=1e-4)


@pytest.mark.parametrize("step", [2, 3])
def test_scattered_depth_is_filled_with_the_nearest(step: int) -> None:
    """As of a coarser depth camera that was registered point by point."""
    wall = np.where(np.arange(160) < 80, 1000, 2000).astype(np.uint16)
    whole = np.broadcast_to(wall, (120, 160)).copy()
    scattered = np.zeros_like(whole)
    scattered[1::step, 1::step] = whole[1::step, 1::step]
    scattered[40:80, 20:60] = 0
    filled = filled_depth(scattered)
    assert filled.dtype == np.uint16
    assert set(np.unique(filled)) == {0, 1000, 2000}  # nothing between two surfaces
    assert (filled[:30, :76] == 1000).all() and (filled[:30, 84:] == 2000).all()
    assert (filled[45:75, 25:55] == 0).all()  # a hole stays one
    np.testing.assert_array_equal(filled[scattered > 0], scattered[scattered > 0])
    metres = np.where(scattered > 0, scattered / np.float32(1000), np.float32(np.nan))
    np.testing.assert_allclose(filled_depth(metres)[filled > 0], filled[filled > 0] / 1000)


def test_other_depth_is_kept_as_it_is() -> None:
    rng = np.random.default_rng(0)
    depth = rng.integers(1000, 2000, (120, 160)).astype(np.uint16)
    assert filled_depth(depth) is depth
    depth[rng.random(depth.shape) < 0.1] = 0
    depth[:, :120] = 0
    assert filled_depth(depth) is depth
    nothing = np.zeros_like(depth)
    assert filled_depth(nothing) is nothing
