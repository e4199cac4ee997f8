"""The surface of exact scenes: planes, what moved away, thin walls, crumbs, order."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from surface_scene import CAMERA, as_map, plane_rho, poses

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, transform
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.mesh_files import write_glb, write_mesh
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame, mark_unexplained
from bmask_slam.mapping.surface.extraction import MIN_WITNESSES, Surface, extract, without_crumbs
from bmask_slam.mapping.surface.gate import KeyframeSurface, judge_of
from bmask_slam.mapping.surface.pixel_planes import NX, RIM, WEIGHT
from bmask_slam.mapping.surface.volume import SurfaceVolume

NORMAL, OFFSET_M, VOXEL_M, SIGMA = np.array([0.2, -0.1, 1.0]), 2.0, 0.05, 0.002
LENGTH = float(np.linalg.norm(NORMAL))
POSES = poses(np.random.default_rng(1), 5)


def frame(rho: Array, T: Array, colour: int = 200, sigma: float = SIGMA) -> DepthFrame:
    rgb = np.full((30, 40, 3), colour, np.uint8)
    return depth_frame(as_map(rho, sigma), rgb, T, CAMERA, VOXEL_M)


def plane(T: Array, colour: int = 200) -> DepthFrame:
    return frame(plane_rho(T, NORMAL, OFFSET_M), T, colour)


def surface_of(frames: list[DepthFrame], min_witnesses: float = MIN_WITNESSES) -> Surface:
    volume = SurfaceVolume(VOXEL_M, CAMERA, blocks=4)
    for given in frames:
        volume.integrate(given)
    return extract(volume, min_witnesses)


def test_a_plane_is_found_with_its_normals_facing_the_cameras() -> None:
    found = surface_of([plane(T) for T in POSES])
    assert len(found.vertices) > 300
    assert np.abs(found.vertices @ NORMAL - OFFSET_M).max() / LENGTH < 0.002
    np.testing.assert_allclose(found.normals @ NORMAL / LENGTH, -1, atol=1e-3)
    a, b, c = (found.vertices[found.triangles[:, k]] for k in range(3))
    assert (np.cross(b - a, c - a) @ NORMAL < 0).all()
    assert (found.colours == 200).all()
    assert found.views.max() == len(POSES)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.49, 0.5, 0.51])
def test_a_plane_is_whole_wherever_it_lies_between_voxels(share: float) -> None:
    rng, z_m = np.random.default_rng(0), OFFSET_M + share * VOXEL_M

    def columns(noise: Array) -> int:
        """Of voxels along z in which the surface is."""
        found = surface_of([frame(1 / (z_m + n), np.eye(4)) for n in noise]).vertices
        return len(np.unique(np.floor(found[:, :2] / VOXEL_M), axis=0))

    exact, noisy = columns(np.zeros((1, 30, 40))), columns(rng.normal(0, 0.001, (9, 30, 40)))
    assert noisy > 0.99 * exact > 1000  # noise moves some beyond the image's edge


def test_normals_of_noisy_walls_are_smooth_up_to_their_edge() -> None:
    """Two walls that meet at a right angle, with noise; a mean over the edge is off by up to 45."""
    u = (np.arange(40) - CAMERA.cx) / CAMERA.fx
    z_m = np.tile(2.0 / (1 + np.abs(u)), (30, 1))
    noise = np.random.default_rng(0).normal(0, 0.01, (4, 30, 40))
    found = surface_of([frame(1 / (z_m + n), np.eye(4)) for n in noise])
    x = found.vertices[:, 0]
    true = np.stack([-np.sign(x), np.zeros(len(x)), -np.ones(len(x))], axis=1) / 2**0.5
    off_deg = np.degrees(np.arccos((found.normals * true).sum(axis=1).clip(-1, 1)))
    near = (np.abs(x) > 0.8 * VOXEL_M) & (np.abs(x) < 2.5 * VOXEL_M)
    assert np.median(off_deg) < 2  # 3.6 without means
    assert off_deg[near].mean() < 5  # 6.8 by means over the edge as well


def test_weights_are_the_sum_of_the_inverse_variances() -> None:
    """sigma_d = sigma_z cos(angle), sigma_z = sigma_rho z^2, and 10 mm; in 1/cm^2."""
    T = np.eye(4)
    one, two = (surface_of([frame(np.full((30, 40), 0.5), T)] * n, n) for n in (1, 2))
    centre = np.linalg.norm(one.vertices[:, :2], axis=1).argmin()
    sigma_m = SIGMA * 2.0**2
    assert one.weights[centre] == pytest.approx(1e-4 / (sigma_m**2 + 0.01**2), rel=0.01)
    np.testing.assert_allclose(two.weights, 2 * one.weights, rtol=1e-3)


def test_the_surface_moves_with_the_world() -> None:
    """Not to the bit: the voxels are elsewhere on it."""
    move = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, -2.0, 0.7]))
    moved = surface_of([frame(plane_rho(T, NORMAL, OFFSET_M), move @ T) for T in POSES])
    back = transform(inverse(move), moved.vertices.astype(float))
    assert np.abs(back @ NORMAL - OFFSET_M).max() / LENGTH < 0.002
    np.testing.assert_allclose(moved.normals @ move[:3, :3] @ NORMAL / LENGTH, -1, atol=1e-3)


def test_the_same_frames_give_the_same_bytes_in_another_table() -> None:
    frames = [plane(T, 10 * k) for k, T in enumerate(POSES)]
    one = surface_of(frames)
    volume = SurfaceVolume(VOXEL_M, CAMERA, blocks=2000)
    for given in frames:
        volume.integrate(given)
    other = extract(volume)
    for name, values in vars(one).items():
        np.testing.assert_array_equal(values, getattr(other, name))


def test_more_certain_frames_weigh_more() -> None:
    T = np.eye(4)
    near, far = (
        frame(np.full((30, 40), rho), T, sigma=s) for rho, s in ((0.5, 4e-4), (0.49, 1e-2))
    )
    z = surface_of([near, far], 1).vertices[:, 2]
    assert abs(np.median(z) - 2.0) < 0.006 < 0.5 / 0.49 - 1


def with_visitor(T: Array) -> Array:
    rho = plane_rho(T, NORMAL, OFFSET_M)
    rho[8:24, 10:26] = 1 / 1.2
    return rho


def test_what_is_seen_through_later_is_removed() -> None:
    T = POSES[0]
    stays = [frame(with_visitor(T), T)] * 4
    assert (surface_of(stays).vertices[:, 2] < 1.5).any()
    leaves = surface_of([*stays, *[plane(T)] * 4])
    assert (leaves.vertices[:, 2] > 1.5).all()


def test_the_gate_drops_what_is_in_front_of_the_keyframes_surface() -> None:
    keyframes = KeyframeSurface(surface_of([plane(T) for T in POSES], 1).vertices, CAMERA)
    verdict = keyframes.judge((1 / with_visitor(POSES[0])).astype(np.float32), POSES[0])
    assert verdict.in_front[8:24, 10:26].all()
    same = keyframes.judge((1 / plane_rho(POSES[0], NORMAL, OFFSET_M)).astype(np.float32), POSES[0])
    assert not same.in_front.any()
    assert not same.unexplained.any()
    away = make_pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    assert keyframes.judge(np.full((30, 40), 2, np.float32), away).unexplained.all()


def with_pole(T: Array) -> Array:
    """Two pixels wide, at 1.5 m."""
    ((x, _, z),) = transform(inverse(T), np.array([[0.05, 0.0, 1.5]]))
    rho, column = plane_rho(T, NORMAL, OFFSET_M), round(CAMERA.fx * x / z + CAMERA.cx)
    rho[:, column : column + 2] = 1 / z
    return rho


def test_the_gate_keeps_thin_things_on_which_keyframes_agree() -> None:
    """A pole is all rims: the surface has nothing of it."""
    vertices = surface_of([frame(with_pole(T), T) for T in POSES], 1).vertices
    assert vertices[:, 2].min() > 1.6
    poles = [((1 / with_pole(T)).astype(np.float32), T) for T in POSES]
    planes = [((1 / plane_rho(T, NORMAL, OFFSET_M)).astype(np.float32), T) for T in POSES]
    assert KeyframeSurface(vertices, CAMERA).judge(*poles[2]).in_front.any()
    assert not judge_of(vertices, poles, CAMERA).judge(*poles[2]).in_front.any()
    passing = [*planes[:2], poles[2], *planes[3:]]
    assert judge_of(vertices, passing, CAMERA).judge(*poles[2]).in_front.any()


def test_what_keyframes_did_not_see_needs_more_witnesses() -> None:
    def seen(count: int) -> int:
        frames = [plane(POSES[0]) for _ in range(count)]
        for given in frames:
            mark_unexplained(given, np.ones((30, 40), bool))
        return len(surface_of(frames).vertices)

    assert seen(11) == 0
    assert seen(12) > 300


@pytest.mark.parametrize(("step", "limit"), [(3, 0.501), (8, 0.5)])
def test_the_limit_between_behind_and_free_is_no_surface(step: int, limit: float) -> None:
    """As where other frames look past the rim of a plate: what is at the rim, none has seen."""
    volume = SurfaceVolume(VOXEL_M, CAMERA)
    volume.integrate(frame(np.full((30, 40), 0.5), np.eye(4)))
    bricks = (volume._origin[: len(volume), None] + volume._bricks).reshape(-1, 1, 3)
    beside = (bricks + volume._voxels)[..., 0] > 0.01
    volume.distance[: len(beside)][beside] = step * VOXEL_M
    found = extract(volume).vertices
    assert len(found) > 100
    assert np.abs(found[:, 2] - 2.0).max() < limit * VOXEL_M


def test_rims_count_little_and_what_flies_beside_them_not_at_all() -> None:
    rho = np.full((30, 40), 0.5)
    rho[:, 20:] = 1 / 3.0
    rho[10, 20] = 1 / 2.4
    pixels = frame(rho, np.eye(4)).pixels.reshape(30, 40, 8)
    weight, normal = pixels[..., WEIGHT], pixels[..., NX : NX + 3]
    np.testing.assert_allclose(weight[4:8, 19], RIM * weight[4:8, 18], rtol=0.05)
    np.testing.assert_allclose(
        normal[4:8, 18:22], torch.tensor([0.0, 0, -1]).expand(4, 4, 3), atol=1e-5
    )
    assert weight[10, 20] == 0


def test_a_thin_wall_has_two_sides() -> None:
    thick_m, T = 3 * VOXEL_M, np.eye(4)
    behind = make_pose(np.diag([-1.0, 1.0, -1.0]), np.array([0.0, 0.0, 4.0 + thick_m]))
    found = surface_of([*[frame(np.full((30, 40), 0.5), P) for P in (T, behind)] * 3])
    front, back = found.normals[:, 2] < -0.9, found.normals[:, 2] > 0.9
    assert abs(np.median(found.vertices[front, 2]) - 2.0) < 0.3 * VOXEL_M
    assert abs(np.median(found.vertices[back, 2]) - 2.0 - thick_m) < 0.3 * VOXEL_M


def test_crumbs_are_removed_and_what_is_left_stays_a_mesh() -> None:
    rho = np.full((30, 40), np.nan)
    rho[4:26, 2:22] = 0.5
    rho[10:14, 28:31] = 0.5
    found = surface_of([frame(rho, np.eye(4))] * 3)
    kept = without_crumbs(found, VOXEL_M)
    assert found.vertices[:, 0].max() > 0.4 > kept.vertices[:, 0].max()
    assert set(kept.triangles.ravel()) == set(range(len(kept.vertices)))
    assert len(without_crumbs(surface_of([]), VOXEL_M).vertices) == 0


def test_the_mesh_is_read_back_by_others(tmp_path: Path) -> None:
    found = surface_of([plane(T) for T in POSES])
    count = len(found.vertices)
    one = np.ones(count, np.float32)
    labels = np.arange(count).astype(np.uint16)
    cloud = Cloud(found.vertices, found.normals, found.colours, one, labels, one, labels)
    write_mesh(tmp_path / "mesh.ply", cloud, found.triangles)
    mesh = load_open3d().io.read_triangle_mesh(str(tmp_path / "mesh.ply"))
    np.testing.assert_array_equal(np.asarray(mesh.triangles), found.triangles)
    np.testing.assert_allclose(np.asarray(mesh.vertices), found.vertices, atol=1e-6)
    np.testing.assert_allclose(np.asarray(mesh.vertex_normals), found.normals, atol=1e-6)


def test_a_mesh_for_viewers_stands_upright(tmp_path: Path) -> None:
    """A floor of the world with y down: up in glTF is y."""
    found = surface_of([frame(np.full((30, 40), 0.5), np.eye(4), 180)] * 3)
    count = len(found.vertices)
    ones, labels = np.ones(count, np.float32), np.full(count, 7, np.uint16)
    cloud = Cloud(found.vertices, found.normals, found.colours, 0.01 * ones, labels, ones, labels)
    up_world = np.array([0.0, -0.8, -0.6])
    path = write_glb(tmp_path / "mesh.glb", cloud, found.triangles, up_world)
    mesh = load_open3d().io.read_triangle_mesh(str(path))
    turned = np.asarray(mesh.vertices)  # in an order of its own
    np.testing.assert_allclose(np.sort(turned[:, 1]), np.sort(found.vertices @ up_world), atol=1e-5)
    assert turned[:, 2].max() < 0  # the first camera looks along -z
    assert len(mesh.triangles) == len(found.triangles)
    mesh.compute_triangle_normals()
    facing = np.asarray(mesh.triangle_normals)
    np.testing.assert_allclose(facing @ [0, 0.6, 0.8], 1, atol=1e-4)  # to the camera
    linear = ((180 / 255 + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(np.asarray(mesh.vertex_colors), linear, atol=1e-3)
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    text = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    sigma = text["bufferViews"][text["meshes"][0]["primitives"][0]["attributes"]["_SIGMA"]]
    first = data.index(b"BIN\0") + 4 + sigma["byteOffset"]
    values = np.frombuffer(data, "<f4", count, first)
    np.testing.assert_array_equal(values, cloud.sigmas_m)
