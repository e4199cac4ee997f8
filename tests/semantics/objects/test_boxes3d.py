"""Oriented boxes and the direction of up."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.semantics.objects.boxes3d import (
    EDGES,
    OrientedBox,
    box_around,
    box_iou,
    gravity_axes,
    main_part,
    seen_again,
    supported,
    without_noise,
)
from bmask_slam.semantics.objects.gravity import GravityEstimator, sample_surface, up_direction
from bmask_slam.semantics.objects.object_map import pixel_rays

T_B_A = se3_exp(np.array([0.7, -0.4, 1.9, 1.0, -2.0, 3.0]))
UP = np.array([0.0, 0.0, 1.0])


def cuboid(rng: np.random.Generator, size_m: Array, count: int = 3000) -> Array:
    """Points (N, 3) on the surface of a box at the origin."""
    points = rng.uniform(-0.5, 0.5, (count, 3))
    side = rng.integers(0, 3, count)
    points[np.arange(count), side] = np.sign(points[np.arange(count), side]) / 2
    return points * size_m


@pytest.mark.parametrize("yaw_deg", [0, 20, 45, 77])
def test_the_box_of_a_rotated_cuboid_equals_the_cuboid(yaw_deg: float) -> None:
    rng, size_m = np.random.default_rng(1), np.array([1.2, 0.5, 0.8])
    T = T_B_A @ se3_exp(np.array([0, 0, np.deg2rad(yaw_deg), 0.3, 0.1, -0.2]))
    box = box_around(transform(T, cuboid(rng, size_m)), T_B_A[:3, :3] @ UP)
    assert np.allclose(box.T_world_box[:3, 3], T[:3, 3], atol=0.01)
    assert np.allclose(np.sort(box.size_m[:2]), [0.5, 1.2], atol=0.02)
    assert box.size_m[2] == pytest.approx(0.8, abs=0.01)
    assert np.allclose(box.T_world_box[:3, 2], T_B_A[:3, :3] @ UP)
    assert np.linalg.det(box.T_world_box[:3, :3]) == pytest.approx(1.0)
    assert box_iou(box, OrientedBox(T, size_m)) > 0.95


def test_what_one_view_alone_shows_is_not_seen_again() -> None:
    """Three views of a plate; the third has a patch of the wall behind it as well."""
    rng = np.random.default_rng(3)
    plate = rng.uniform(0, 0.4, (600, 3)) * [1, 1, 0]
    patch = rng.uniform(0, 0.1, (60, 3)) + np.array([0, 0, 0.5])
    points, views = np.concatenate([plate, patch]), np.append(np.arange(600) % 3, np.full(60, 2))
    kept = seen_again(points, views, 0.03)
    assert kept[:600].mean() > 0.99
    assert not kept[600:].any()
    assert seen_again(points, np.minimum(views, 1), 0.03).all()  # of two views nobody knows


@pytest.mark.parametrize("apart_m", [0.03, 0.06])
def test_views_that_lie_apart_show_each_other(apart_m: float) -> None:
    """Depth of three views of a plate differs; a point's neighbours are all of its own view."""
    plate = np.stack(np.meshgrid(*[np.linspace(0, 0.2, 18)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    points = np.concatenate([plate + np.array([0, 0, k * apart_m]) for k in range(3)])
    assert seen_again(points, np.repeat(np.arange(3), len(plate)), 0.08).all()


def test_lone_points_are_not_supported() -> None:
    rng = np.random.default_rng(2)
    size_m = np.ones(3)
    points = np.concatenate([cuboid(rng, size_m), rng.uniform(2, 6, (5, 3))])
    kept = supported(points, 2, 0.03)
    assert kept.tolist() == [True] * 3000 + [False] * 5
    assert np.allclose(box_around(points[kept], UP).size_m, 1.0, atol=0.01)


def test_a_face_with_few_points_is_inside_the_box() -> None:
    """A book's spine has 2000 points; its cover, at a grazing angle, has eight."""
    rng = np.random.default_rng(3)
    back = rng.uniform(0, 1, (2000, 3)) * [0.03, 0.0, 0.3]
    cover = np.array([[0.0, y, z] for y in (0.08, 0.1, 0.12, 0.14) for z in (0.1, 0.12)])
    points = np.concatenate([back, cover])
    assert supported(points, 2, 0.03).all()
    assert not supported(points, 2, 0.01)[2000:].any()


def test_noise_along_the_rays_does_not_make_a_box_thicker() -> None:
    """A board with many views of its front and few points on a side."""
    rng = np.random.default_rng(5)
    board = rng.uniform(-0.5, 0.5, (2000, 3)) * [0.4, 0.0, 0.3]
    side = np.array([[0.2, y, z] for y in (0.18, 0.2) for z in (0.0, 0.01)])
    for clean, thickness_m in ((board, 0.0), (np.concatenate([board, side]), 0.2)):
        noise = np.zeros_like(clean)
        noise[:, 1] = 0.02  # a sigma of the depth, all rays along y
        points = clean + noise * rng.normal(0, 0.5, (len(clean), 1))
        for T in (np.eye(4), T_B_A):
            here, up = transform(T, points), T[:3, :3] @ UP
            inner = without_noise(here, noise @ T[:3, :3].T, up, 0.02)
            sizes = [np.sort(box_around(p, up).size_m) for p in (here, inner)]
            if thickness_m:
                thinner_m = sizes[0][0] - sizes[1][0]
                assert 0.015 < thinner_m < 0.041  # at most a sigma at either side
            else:
                assert sizes[1][0] < 0.7 * sizes[0][0]
            assert np.allclose(sizes[1][1:], [0.3, 0.4], atol=0.01)
            assert np.allclose(without_noise(here, 0 * noise, up, 0.02), here)


def test_support_equals_a_count_of_neighbours() -> None:
    points = np.random.default_rng(4).normal(size=(80, 3))
    apart = np.sort(np.linalg.norm(points[:, None] - points, axis=2), axis=1)[:, 3]
    assert (supported(points, 3, 0.1) == (apart <= 3 * np.median(apart))).all()
    assert (supported(points, 3, 1e3)).all()
    assert supported(points[:3], 3, 0.0).all()
    assert supported(points, 0, 0.0).all()


def test_one_point_and_a_flat_thing_have_boxes() -> None:
    assert (box_around(np.array([[1.0, 2.0, 3.0]]), UP).size_m > 0).all()
    flat = np.random.default_rng(3).uniform(0, 1, (50, 3)) * [1, 0, 1]
    assert box_around(flat, UP).volume_m3 > 0


def test_iou_of_axis_parallel_boxes_equals_manual_results() -> None:
    a = OrientedBox(np.eye(4), np.array([2.0, 2.0, 2.0]))
    T = np.eye(4)
    T[0, 3] = 1.0
    assert box_iou(a, OrientedBox(T, a.size_m)) == pytest.approx(1 / 3, abs=0.01)
    assert box_iou(a, a) == pytest.approx(1.0)
    small = OrientedBox(np.eye(4), np.array([1.0, 1.0, 1.0]))
    assert box_iou(a, small) == pytest.approx(1 / 8, abs=0.01)
    T[0, 3] = 5.0
    assert box_iou(a, OrientedBox(T, a.size_m)) == 0.0
    moved = [OrientedBox(T_B_A @ b.T_world_box, b.size_m) for b in (a, small)]
    assert box_iou(*moved) == pytest.approx(box_iou(a, small), abs=0.01)


def test_edges_join_corners_along_the_axes() -> None:
    box = OrientedBox(T_B_A, np.array([1.0, 2.0, 3.0]))
    lengths = np.linalg.norm(np.diff(box.corners_world[EDGES], axis=1)[:, 0], axis=1)
    assert sorted(np.round(lengths, 9)) == [1.0] * 4 + [2.0] * 4 + [3.0] * 4


def test_gravity_axes_are_a_rotation_with_up_last() -> None:
    for up in np.random.default_rng(4).normal(size=(5, 3)):
        unit = up / np.linalg.norm(up)
        R = gravity_axes(unit)
        assert np.allclose(R @ R.T, np.eye(3))
        assert np.linalg.det(R) == pytest.approx(1.0)
        assert np.allclose(R[:, 2], unit)


def test_up_is_found_with_all_cameras_pointing_down() -> None:
    rng = np.random.default_rng(5)
    up = se3_exp(np.array([0.3, 0.2, -0.1, 0, 0, 0]))[:3, :3] @ UP
    R = gravity_axes(up)
    walls = np.array([R @ [np.cos(a), np.sin(a), 0] for a in rng.uniform(0, 6.3, 400)])
    floor = up + 0.03 * rng.normal(size=(200, 3))
    floor /= np.linalg.norm(floor, axis=1, keepdims=True)
    tilted = R @ [np.sin(0.5), 0, np.cos(0.5)]  # all cameras pitched by half a radian
    found = up_direction(np.concatenate([walls, floor]), np.tile(tilted, (5, 1)))
    assert np.rad2deg(np.arccos(found @ up)) < 1.0
    without = up_direction(np.zeros((0, 3)), np.tile(tilted, (5, 1)))
    assert np.allclose(without, tilted)


def test_normals_of_a_floor_point_up() -> None:
    """The floor is 1.5 m below a camera pitched by 30 degrees; y_camera is down."""
    camera = Camera(640, 480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)
    rays, pitch = pixel_rays(camera, 2), np.deg2rad(30)
    up_camera = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
    depth_m = (-1.5 / (rays @ up_camera)).astype(np.float32)
    depth_m[(depth_m < 0) | (depth_m > 6)] = np.nan
    assert np.allclose(sample_surface(depth_m, rays)[1], up_camera, atol=1e-4)
    upright = GravityEstimator()
    upright.add(4, depth_m, rays)
    found = upright.up_world({4: T_B_A})
    assert np.allclose(found, T_B_A[:3, :3] @ up_camera, atol=1e-4)
    assert np.allclose(upright.up_world({}), [0, -1, 0])


def test_what_hangs_apart_is_no_part_of_a_thing() -> None:
    rng = np.random.default_rng(4)
    chair = rng.uniform([0, 0, 2.0], [0.5, 0.9, 2.1], (300, 3))
    wall = rng.uniform([0.1, 0.2, 3.0], [0.4, 0.8, 3.02], (60, 3))
    points = np.concatenate([chair, wall])
    kept = main_part(points, 0.12, 0.35)
    assert kept[:300].all()
    assert not kept[300:].any()
    halves = np.concatenate([chair, chair + np.array([1.5, 0, 0])])
    assert main_part(halves, 0.12, 0.35).all()  # two large parts, such as a table behind a screen
    assert main_part(points[:1], 0.12, 0.35).tolist() == [True]
