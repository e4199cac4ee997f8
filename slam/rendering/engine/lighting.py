"""Light that does not depend on the view point, baked into textures once per scene.

Lambert's law for lamps with soft shadows, plus an ambient term with occlusion: exact for diffuse
surfaces, at no cost per frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Image, Mask
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.rendering.engine.builder import Part
from bmask_slam.rendering.engine.meshes import Shape

_CELL_M = 0.05
_SKY_RAYS = 24
_SKY_REACH_M = 0.9


@dataclass(frozen=True)
class Lamp:
    """A lamp: centre in metres, power, half size along x and y in metres.

    At distance d it gives power / (0.5 + d^2) to a surface that faces it.
    """

    centre: tuple[float, float, float]
    power: float = 1.6
    half_size: tuple[float, float] = (0.5, 0.15)


@dataclass(frozen=True)
class Lighting:
    """The lamps and the share of light that comes from everywhere."""

    lamps: tuple[Lamp, ...]
    ambient: float = 0.5


def irradiance(lighting: Lighting, points: Array, normals: Array) -> Array:
    """Unshadowed light (N,) on points (N, 3) with unit normals (N, 3); for moving things."""
    total = np.full(len(points), 0.9 * lighting.ambient)
    for lamp in lighting.lamps:
        total += _from_lamp(lamp, np.asarray(lamp.centre), points, normals)
    return total


def _from_lamp(lamp: Lamp, centre: Array, points: Array, normals: Array) -> Array:
    to_lamp = centre - points
    distance2 = (to_lamp**2).sum(-1)
    cosine = np.einsum("nj,nj->n", to_lamp, normals) / np.sqrt(distance2 + 1e-9)
    return lamp.power * np.maximum(cosine, 0) / (0.5 + distance2)


def bake(parts: list[Part], lighting: Lighting, seed: int) -> list[Part]:
    """The parts with their light: in the textures of flat ones, at the corners of others.

    Parts whose light is baked already stay as they are, and cast shadows.
    """
    dark = [part for part in parts if part.light is None]
    if not dark:
        return parts
    scene = _scene(parts)
    grids = [_grid(part) for part in dark]
    points = np.concatenate([g[0] for g in grids])
    normals = np.concatenate([g[1] for g in grids])
    light = _gather(scene, lighting, points, normals, np.random.default_rng(seed))
    ends = np.cumsum([len(grid[0]) for grid in grids])
    own = iter(np.split(light, ends[:-1]))
    shapes = iter([grid[2] for grid in grids])
    return [
        _with_light(part, next(own).reshape(next(shapes))) if part.light is None else part
        for part in parts
    ]


def _with_light(part: Part, light: Array) -> Part:
    """The part with the light of its ``_grid``."""
    everywhere = np.ones((len(part.shape.corners), 3))
    if part.shines:
        return replace(part, light=everywhere)
    if part.flat:
        return replace(part, texture=_lit(part.texture, light), light=everywhere)
    return replace(part, light=light)


def _scene(parts: list[Part]) -> Any:
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    corners = np.concatenate([p.shape.corners for p in parts]).astype(np.float32)
    index = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(corners.reshape(-1, 3)), o3d.core.Tensor(index))
    return scene


def _grid(part: Part) -> tuple[Array, Array, tuple[int, ...]]:
    """Where the light of a part is computed: points, normals and the shape of the answer."""
    shape: Shape = part.shape
    if not part.flat:
        return shape.corners.reshape(-1, 3), shape.normals.reshape(-1, 3), (len(shape.corners), 3)
    origin, right, below = shape.corners[0, 0], shape.corners[0, 1], shape.corners[0, 2]
    u, v = right - origin, below - right
    columns, rows = (int(np.clip(np.linalg.norm(e) / _CELL_M, 2, 400)) for e in (u, v))
    s, t = (np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows
    points = origin + s[None, :, None] * u + t[:, None, None] * v
    normals = np.broadcast_to(shape.normals[0, 0], points.shape)
    return points.reshape(-1, 3), normals.reshape(-1, 3), (rows, columns)


def _lit(texture: Image, light: Array) -> Image:
    rows, columns = texture.shape[:2]
    smooth = cv2.resize(light.astype(np.float32), (columns, rows), interpolation=cv2.INTER_LINEAR)
    return np.clip(texture * smooth[..., None] + 0.5, 0, 255).astype(np.uint8)


def _gather(
    scene: Any, lighting: Lighting, points: Array, normals: Array, rng: np.random.Generator
) -> Array:
    start = points + 3e-3 * normals
    total = lighting.ambient * _open_sky(scene, start, normals, rng)
    for lamp in lighting.lamps:
        for corner in ((-1, -1), (1, -1), (-1, 1), (1, 1), (0, 0)):
            jitter = rng.uniform(-0.3, 0.3, (len(points), 2)) + corner
            centre = np.asarray(lamp.centre) + np.stack(
                [
                    jitter[:, 0] * lamp.half_size[0],
                    jitter[:, 1] * lamp.half_size[1],
                    np.zeros(len(points)),
                ],
                -1,
            )
            visible = ~_blocked(scene, start, centre - start, 0.97)
            total += 0.2 * visible * _from_lamp(lamp, centre, points, normals)
    return total


def _open_sky(scene: Any, start: Array, normals: Array, rng: np.random.Generator) -> Array:
    """The share of cosine-weighted directions that are free within reach, (N,) in [0.25, 1]."""
    free = np.zeros(len(start))
    for _ in range(_SKY_RAYS):
        direction = rng.normal(size=start.shape)
        direction = direction / np.linalg.norm(direction, axis=1, keepdims=True) + 1.0001 * normals
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        free += ~_blocked(scene, start, direction, _SKY_REACH_M)
    return 0.25 + 0.75 * free / _SKY_RAYS


def _blocked(scene: Any, start: Array, direction: Array, reach: float) -> Mask:
    o3d = load_open3d()
    rays = np.empty((len(start), 6), np.float32)
    rays[:, :3], rays[:, 3:] = start, direction
    blocked: Mask = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=reach).numpy()
    return blocked
