"""Free space by views of a plane with a box before it, in a random world frame."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.moving.depth_segments import DepthSegmentConfig, depth_segments
from bmask_slam.moving.depth_view_buffer import DepthViewBuffer
from bmask_slam.moving.free_space_check import (
    FreeSpaceCheck,
    FreeSpaceCheckConfig,
    PointMotion,
    depth_view,
)

CAMERA = Camera(160, 120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
CHECK = FreeSpaceCheck(CAMERA, CAMERA.noise_of_depth(), FreeSpaceCheckConfig())
T_WORLD_CAMERA = se3_exp(np.array([0.3, -0.7, 0.2, 1.0, 2.0, -0.5]))


def box_before_wall() -> Array:
    """A wall 3 m away with a box of 2 m in its middle, and a hole in the depth at the left."""
    depth_m = np.full((120, 160), 3.0, np.float32)
    depth_m[40:80, 60:100] = 2.0
    depth_m[:, :20] = np.nan
    return depth_m


def verdict(u: float, v: float, z: float, T: Array = T_WORLD_CAMERA) -> int:
    point = CAMERA.backproject(np.array([[u, v]]), np.array([z]))
    view = depth_view(box_before_wall(), CHECK.config.window_px)
    return int(CHECK.judge(transform(T_WORLD_CAMERA, point), view, T)[0])


@pytest.mark.parametrize(
    ("u", "v", "z", "expected"),
    [
        (80, 60, 2.0, PointMotion.STATIC),  # on the box
        (80, 60, 1.5, PointMotion.MOVING),  # before it
        (80, 60, 2.7, PointMotion.UNKNOWN),  # inside it, hidden
        (80, 60, 3.0, PointMotion.UNKNOWN),  # the wall behind it
        (130, 30, 3.0, PointMotion.STATIC),  # on the wall
        (130, 30, 3.03, PointMotion.STATIC),  # within the depth's noise
        (130, 30, 2.0, PointMotion.MOVING),  # where the box is not
        (61, 41, 2.5, PointMotion.UNKNOWN),  # the box's corner, between the two
        (58, 60, 2.3, PointMotion.UNKNOWN),  # a pixel beside the box: its edge is ragged
        (10, 60, 1.0, PointMotion.UNKNOWN),  # no depth
        (300, 60, 1.0, PointMotion.UNKNOWN),  # out of view
        (80, 60, -1.0, PointMotion.UNKNOWN),  # behind the camera
    ],
)
def test_points_are_static_moving_or_unknown(
    u: float, v: float, z: float, expected: PointMotion
) -> None:
    assert verdict(u, v, z) == expected


def test_pose_errors_are_tolerated() -> None:
    T_off = T_WORLD_CAMERA @ se3_exp(np.array([0.01, -0.01, 0.02, 0.02, 0.0, 0.02]))
    assert verdict(130, 30, 3.0, T_off) == PointMotion.STATIC
    assert verdict(130, 30, 2.0, T_off) == PointMotion.MOVING


def test_the_check_equals_a_loop_over_points() -> None:
    rng = np.random.default_rng(0)
    pixels, z = rng.uniform(0, [200, 150], (400, 2)) - 20, rng.uniform(0.5, 4, 400)
    points = transform(T_WORLD_CAMERA, CAMERA.backproject(pixels, z))
    depth_m = box_before_wall()
    found = CHECK.judge(points, depth_view(depth_m, 5), T_WORLD_CAMERA)
    expected = [reference(p, depth_m) for p in transform(inverse(T_WORLD_CAMERA), points)]
    assert np.mean(found == np.array(expected)) > 0.98  # it looks at every second pixel


def reference(p: Array, depth_m: Array) -> int:
    u, v = 130 * p[0] / p[2] + 79.5, 130 * p[1] / p[2] + 59.5
    if not (0 < u < 159 and 0 < v < 119):
        return 0
    u, v = round(u / 2) * 2, round(v / 2) * 2
    window = depth_m[max(v - 4, 0) : v + 5, max(u - 4, 0) : u + 5]
    if np.isnan(window).all():
        return 0
    near, far = np.nanmin(window), np.nanmax(window)

    def margin(d: float) -> float:
        return 0.1 + 4 * 0.08 / 40 * float(np.hypot(d**2, p[2] ** 2))

    if not np.isnan(window).any() and near - p[2] > margin(near):
        return -1
    holes = np.isnan(window).any()
    return int((not holes and abs(near - p[2]) < margin(near)) or abs(far - p[2]) < margin(far))


def test_views_decide_by_majority_without_unknown_ones() -> None:
    motions = np.array([[-1, -1, 0, 1], [-1, 1, 0, 0], [1, 0, 0, 0]], np.int8)
    assert CHECK.agree(motions).tolist() == [-1, 0, 0, 1]


def test_unknown_points_follow_neighbours_of_the_same_depth() -> None:
    pixels = np.array([[10, 10], [12, 10], [14, 12], [11, 12], [13, 11], [12, 14], [90, 90.0]])
    depth_m = np.array([2.0, 2.0, 2.0, 2.02, 3.0, np.nan, 2.0])
    point_motions = np.array([-1, -1, -1, 0, 0, 0, 0], np.int8)
    assert CHECK.spread(pixels, depth_m, point_motions).tolist() == [-1, -1, -1, -1, 0, -1, 0]
    static = np.abs(point_motions)
    assert CHECK.spread(pixels, depth_m, static).tolist() == static.tolist()


@pytest.mark.parametrize(
    "shares, apart_s, still",
    [
        ((1.0, 1.0), (1.5, -1.2), True),
        ((1.0, 1.0), (1.5, 0.5), False),  # one of the views is too near in time
        ((1.0, 0.8), (1.5, 1.2), False),
        ((0.0, 0.8), (0.2, 1.2), False),
        ((1.0, 0.95, 0.0), (1.5, 1.2, 0.3), True),
    ],
)
def test_points_in_many_views_are_static(
    shares: tuple[float, ...], apart_s: tuple[float, ...], still: bool
) -> None:
    point_motions = np.array([np.where(np.arange(100) < 100 * s, 1, -1) for s in shares], np.int8)
    assert CHECK.stood_still(point_motions, np.array(apart_s), 20) is still
    hidden = np.concatenate([point_motions, np.zeros_like(point_motions)], axis=1)
    assert CHECK.stood_still(hidden, np.array(apart_s), 20) is still
    assert not CHECK.stood_still(hidden, np.array(apart_s), 120)
    assert not CHECK.stood_still(np.zeros((2, 5), np.int8), np.array([2.0, 3.0]), 1)


def test_the_buffer_keeps_views_spaced_in_time_and_is_restored() -> None:
    memory, other = DepthViewBuffer(3, 0.25), DepthViewBuffer(3, 0.25)
    for k in range(12):
        pose = se3_exp(np.full(6, 0.1 * k)) if k > 3 else None
        memory.add(k, 0.1 * k, depth_view(box_before_wall() + k, 5), T_keyframe_camera=pose)
    assert [v.keyframe_id for v in memory.views] == [3, 6, 9]
    memory.clear_depth(6, np.ones(box_before_wall().shape, bool))
    other.restore(memory.state())
    for a, b in zip(memory.views, other.views, strict=True):
        assert (a.keyframe_id, a.timestamp_s, a.view.step) == (
            b.keyframe_id,
            b.timestamp_s,
            b.view.step,
        )
        np.testing.assert_array_equal(a.T_keyframe_camera, b.T_keyframe_camera)
        for one, two in ((a.view, b.view), (a.full, b.full)):
            np.testing.assert_array_equal(one.nearest_m, two.nearest_m)
            np.testing.assert_array_equal(one.farthest_m, two.farthest_m)
    assert [bool(v.view.nearest_m.any()) for v in memory.views] == [True, False, True]


def test_moving_pixels_are_removed_from_stored_views() -> None:
    depth_m = box_before_wall()
    regions = depth_segments(depth_m, DepthSegmentConfig(step_px=8))
    nearer = regions.depth_m < 2.5
    memory = DepthViewBuffer(6, 0.25)
    memory.add(0, 0.0, depth_view(depth_m, 5), regions.space(nearer))
    kept = memory.views[0]
    there = (kept.full.nearest_m < 2.5) & (kept.full.nearest_m > 0)
    assert there.any()
    assert not kept.view.nearest_m[there].any()
    assert not kept.view.farthest_m[there].any()
    np.testing.assert_array_equal(kept.view.nearest_m[~there], kept.full.nearest_m[~there])
    memory.restore_depth(1, np.ones(depth_m.shape, bool))
    assert not kept.view.nearest_m[there].any()
    memory.restore_depth(0, np.ones(depth_m.shape, bool))
    np.testing.assert_array_equal(kept.view.nearest_m, kept.full.nearest_m)
    np.testing.assert_array_equal(kept.view.farthest_m, kept.full.farthest_m)
    assert all(v.full.nearest_m.any() for v in memory.views)


@pytest.mark.parametrize("bad", [{"margin_m": 0.0}, {"views": 0}, {"window_px": -1}])
def test_bad_configuration_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        FreeSpaceCheckConfig(**bad)  # type: ignore[arg-type]
