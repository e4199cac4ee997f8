"""Fiducial markers on the walls of a rendered scene, where the camera will see them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.features.marker_detection import dictionary_of, draw_marker
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import make_pose, quaternion_from_rotation
from bmask_slam.graph.sensors.markers import MarkersConfig
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.rendering.engine.builder import Part, SceneBuilder
from bmask_slam.rendering.engine.path import CameraPath, duration_s, steady_poses
from bmask_slam.rendering.engine.raycast import Geometry, build_geometry

MARKER_SIZE_M = 0.2
"""Edge of the black square."""
TRUTH = "markers_truth.txt"
_EVERY_S, _APART_M, _MOST = 0.5, 1.5, 60
_NEAR_M, _FAR_M, _LOW_M, _HIGH_M = 0.9, 2.6, 0.8, 2.0
_FLAT_M, _WINDOW, _OFF_M = 0.013, 1.9, 0.004
"""A spot is flat to so many metres over so many sizes; the print lies so far before the surface."""
_BORDER, _MODULE_PX = 1, 16
"""White modules around the square, and texels of a module."""
_VIEW = Camera(64, 48, fx=52.5, fy=52.5, cx=31.5, cy=23.5)


@dataclass(frozen=True)
class PlacedMarker:
    """A marker in the scene: its number, and T_world_marker (4, 4)."""

    number: int
    T_world_marker: Array


def add_markers(b: SceneBuilder, path: CameraPath) -> list[PlacedMarker]:
    """Put markers on flat, free, upright surfaces along a path, at least 1.5 m apart."""
    scene = _scene(b.parts)
    placed: list[PlacedMarker] = []
    for T in steady_poses(path, np.arange(0.0, duration_s(path), _EVERY_S)):
        if len(placed) == _MOST:
            break
        spot = _best_spot(scene, T, [m.T_world_marker[:3, 3] for m in placed])
        if spot is not None:
            placed.append(PlacedMarker(len(placed), _rolled(*spot, len(placed))))
    config = MarkersConfig()
    for marker in placed:
        _hang(b, marker, config)
    return placed


def write_truth(folder: Path, placed: list[PlacedMarker]) -> None:
    """Write the poses of markers in the frame of groundtruth.txt."""
    lines = [
        f"# markers {MarkersConfig().dictionary} of {MARKER_SIZE_M:g} m: T_world_marker, exact",
        "# id tx ty tz qx qy qz qw",
    ]
    for marker in placed:
        T = marker.T_world_marker
        numbers = (*T[:3, 3], *quaternion_from_rotation(T[None, :3, :3])[0])
        lines.append(f"{marker.number} " + " ".join(f"{x:.9f}" for x in numbers))
    (folder / TRUTH).write_text("\n".join(lines) + "\n", encoding="utf-8")


def _scene(parts: list[Part]) -> Geometry:
    corners = np.concatenate([part.shape.corners for part in parts])
    nothing = np.zeros(len(corners))
    return build_geometry(
        corners, np.zeros((len(corners), 3, 2)), np.zeros((len(corners), 3)), nothing, nothing
    )


def _cast(scene: Geometry, origins: Array, directions: Array) -> tuple[Array, Array]:
    """Distances (N,) in lengths of the directions, and unit normals (N, 3) of what is hit."""
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=1).astype(np.float32)
    answer = scene.scene.cast_rays(load_open3d().core.Tensor(rays), nthreads=1)
    return answer["t_hit"].numpy().astype(float), answer["primitive_normals"].numpy().astype(float)


def _best_spot(scene: Geometry, T: Array, taken: list[Array]) -> tuple[Array, Array] | None:
    """Point and normal, both (3,), of the spot that the camera sees best; None if there is none."""
    v, u = np.mgrid[4 : _VIEW.height - 4 : 2, 4 : _VIEW.width - 4 : 2]
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2).astype(float)
    rays = _VIEW.backproject(pixels, np.array(1.0)) @ T[:3, :3].T
    t, normals = _cast(scene, T[:3, 3], rays)
    points = T[:3, 3] + t[:, None] * rays
    towards = -rays / np.linalg.norm(rays, axis=1, keepdims=True)
    facing = np.sum(normals * towards, axis=1)
    normals, facing = normals * np.sign(facing)[:, None], np.abs(facing)
    good = (t > _NEAR_M) & (t < _FAR_M) & (np.abs(normals[:, 2]) < 0.02) & (facing > 0.6)
    good &= (points[:, 2] > _LOW_M) & (points[:, 2] < _HIGH_M)
    for place in taken:
        good &= np.linalg.norm(points - place, axis=1) > _APART_M
    rows = np.flatnonzero(good)
    for k in rows[np.argsort(-facing[rows], kind="stable")][:40].tolist():
        if _is_free(scene, T[:3, 3], points[k], normals[k]):
            return points[k], normals[k]
    return None


def _is_free(scene: Geometry, eye: Array, point: Array, normal: Array) -> bool:
    """Whether the surface is flat around a point, and nothing hides it from the eye."""
    side = np.linspace(-0.5, 0.5, 9) * _WINDOW * MARKER_SIZE_M
    a, b = (x.ravel() for x in np.meshgrid(side, side))
    right = np.cross([0.0, 0.0, 1.0], normal)
    around = point + a[:, None] * right + b[:, None] * [0.0, 0.0, 1.0]
    t, _ = _cast(scene, eye, around - eye)
    off_m = np.abs(t - 1) * np.linalg.norm(around - eye, axis=1)
    return bool((off_m < _FLAT_M).all())


def _rolled(point: Array, normal: Array, number: int) -> Array:
    """T_world_marker (4, 4) before a wall, turned by some degrees about its normal."""
    normal = normal * [1.0, 1.0, 0.0]
    normal = normal / np.linalg.norm(normal)
    right, up = np.cross([0.0, 0.0, 1.0], normal), np.array([0.0, 0.0, 1.0])
    roll_rad = np.radians(37 * number % 41 - 20)
    c, s = np.cos(roll_rad), np.sin(roll_rad)
    R = np.stack([c * right + s * up, c * up - s * right, normal], axis=1)
    return make_pose(R, point + _OFF_M * normal)


def _hang(b: SceneBuilder, marker: PlacedMarker, config: MarkersConfig) -> None:
    """Add the print with its white border."""
    modules = int(dictionary_of(config).markerSize) + 2
    sheet = np.full(((modules + 2 * _BORDER) * _MODULE_PX,) * 2, 255, np.uint8)
    inside = slice(_BORDER * _MODULE_PX, -_BORDER * _MODULE_PX)
    sheet[inside, inside] = draw_marker(config, marker.number, modules * _MODULE_PX)
    picture: Image = np.repeat((10 + 0.9 * sheet).astype(np.uint8)[..., None], 3, axis=2)
    half_m = MARKER_SIZE_M * (modules + 2 * _BORDER) / modules / 2
    T, right = marker.T_world_marker, 2 * half_m * marker.T_world_marker[:3, 0]
    down = -2 * half_m * T[:3, 1]
    b.quad(T[:3, 3] - right / 2 - down / 2, right, down, lambda *_: picture)
