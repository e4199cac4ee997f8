"""Ray casting of textured triangles with Open3D, and their shading by filtered look-up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Image, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.rendering.engine.atlas import Atlas, sample

_MISS = np.uint32(0xFFFFFFFF)
_QUARTERS = (
    (-0.25, -0.25, 0.125), (0.25, -0.25, 0.625), (-0.25, 0.25, 0.875), (0.25, 0.25, 0.375),
)  # fmt: skip
"""Offsets in x and y within the pixel, and offsets of the mip level before truncation."""
_EDGE_CONTRAST = 14.0


@dataclass(frozen=True)
class Geometry:
    """T triangles ready for casting.

    Attributes:
        scene: Open3D's RaycastingScene; built by one thread, so that it is always the same.
        rows: (T, 16) float32: three rows (gradient, constant) of the functions u, v and light of
            the world point, then the unit normal, then padding.
        texture: (T,) int32 index in the atlas.
        instance: (T,) int32 id, 0 for background.
    """

    scene: Any
    rows: Floats
    texture: NDArray[np.int32]
    instance: NDArray[np.int32]


@dataclass(frozen=True)
class View:
    """A noise-free picture: rgb (H, W, 3) float32, z-depth in metres and normals in the camera.

    Depth (H, W) float32 is NaN where no surface is hit; ``normals`` (H, W, 3) point to the camera;
    ``instances`` (H, W) are ids, 0 for background.
    """

    rgb: Floats
    depth_m: Floats
    normals: Floats
    instances: NDArray[np.uint16]


def build_geometry(
    corners: Array, uvs: Array, light: Array, texture: NDArray[Any], instance: NDArray[Any]
) -> Geometry:
    """Prepare triangles: corners (T, 3, 3) world, uvs (T, 3, 2), light (T, 3) at the corners."""
    o3d = load_open3d()
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    # The tables must describe the very triangles that are hit: float32 corners.
    corners = np.ascontiguousarray(corners, np.float32)
    index = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(corners.reshape(-1, 3)), o3d.core.Tensor(index))
    rows = np.zeros((len(corners), 16), np.float32)
    values = np.concatenate([uvs, light[..., None]], axis=-1)
    rows[:, :12] = _affine(corners.astype(float), values).reshape(-1, 12)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    rows[:, 12:15] = normal / (np.linalg.norm(normal, axis=1, keepdims=True) + 1e-20)
    return Geometry(scene, rows, texture.astype(np.int32), instance.astype(np.int32))


def _affine(corners: Array, values: Array) -> Array:
    """Rows (T, C, 4) of the linear functions with ``values`` (T, 3, C) at ``corners``."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(e1, e2)
    scale = 1 / np.maximum((normal**2).sum(1), 1e-24)
    dual1, dual2 = np.cross(e2, normal) * scale[:, None], np.cross(normal, e1) * scale[:, None]
    d1, d2 = values[:, 1] - values[:, 0], values[:, 2] - values[:, 0]
    gradient = d1[:, :, None] * dual1[:, None] + d2[:, :, None] * dual2[:, None]
    constant = values[:, 0] - np.einsum("tcj,tj->tc", gradient, corners[:, 0])
    return np.concatenate([gradient, constant[..., None]], axis=-1)


class Renderer:
    """Draws a static scene, and moving things in it, from given poses.

    Poses are T_world_camera (4, 4), or of each row (H, 4, 4) of a rolling shutter.
    """

    def __init__(self, camera: Camera, atlas: Atlas, static: Geometry) -> None:
        self._camera, self._atlas, self._static = camera, atlas, static
        v, u = np.mgrid[: camera.height, : camera.width]
        self._pixels = np.stack([u, v], -1).reshape(-1, 2).astype(np.float32)

    def render(self, T_world_camera: Array, moving: Geometry | None = None) -> View:
        """Draw one view; rays go through pixel centres, edges of things are supersampled."""
        h, w = self._camera.height, self._camera.width
        layers, tables = _stack(self._static, moving)
        exposed = _when_exposed(T_world_camera, self._pixels)
        hits = self._cast(layers, self._pixels, exposed)
        colour = self._shade(tables, hits, exposed)
        surface = tables[1][hits[1]].reshape(h, w)
        edges = _edges(surface, hits[0].reshape(h, w), colour.reshape(h, w, 3)).ravel()
        colour[edges] = self._supersample(layers, tables, self._pixels[edges], T_world_camera)
        instances = np.where(hits[1] >= 0, tables[2][hits[1]], 0).astype(np.uint16)
        return View(
            colour.reshape(h, w, 3), *self._geometry(tables, hits, T_world_camera),
            instances.reshape(h, w),
        )  # fmt: skip

    def render_depth(
        self, T_world_camera: Array, moving: Geometry | None = None
    ) -> tuple[Floats, Floats]:
        """Depth and normals of `render` alone, at less than half of its time."""
        layers, tables = _stack(self._static, moving)
        hits = self._cast(layers, self._pixels, _when_exposed(T_world_camera, self._pixels))
        return self._geometry(tables, hits, T_world_camera)

    def _geometry(
        self, tables: _Tables, hits: _Hits, T_world_camera: Array
    ) -> tuple[Floats, Floats]:
        """Depth (H, W), NaN where nothing is hit, and normals (H, W, 3) toward the camera."""
        h, w = self._camera.height, self._camera.width
        t, triangle, rays = hits
        depth = np.where(triangle >= 0, t, np.nan).astype(np.float32)
        normals, _ = _facing(tables[0][:, 12:15].take(triangle, axis=0, mode="clip"), rays)
        normals = normals.reshape(h, w, 3) @ T_world_camera[..., :3, :3].astype(np.float32)
        return depth.reshape(h, w), normals

    def _supersample(
        self, layers: list[Geometry], tables: _Tables, pixels: Floats, T_world_camera: Array
    ) -> Floats:
        if len(pixels) == 0:
            return np.zeros((0, 3), np.float32)
        offsets = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], np.float32) / np.float32(4)
        many = (pixels[None] + offsets[:, None]).reshape(-1, 2)
        exposed = _when_exposed(T_world_camera, many)
        colour = self._shade(tables, self._cast(layers, many, exposed), exposed)
        return colour.reshape(4, -1, 3).mean(0)

    def _cast(self, layers: list[Geometry], pixels: Floats, exposed: _Exposed) -> _Hits:
        """Nearest hits of rays whose direction has z = 1 in the camera, so that t is z-depth."""
        camera, (R, origin) = self._camera, exposed
        x = (pixels[:, 0] - np.float32(camera.cx)) / np.float32(camera.fx)
        y = (pixels[:, 1] - np.float32(camera.cy)) / np.float32(camera.fy)
        rays = np.empty((len(pixels), 6), np.float32)
        rays[:, :3] = origin.T
        for k in range(3):
            rays[:, 3 + k] = R[k, 0] * x + R[k, 1] * y + R[k, 2]
        o3d = load_open3d()
        t = np.full(len(rays), np.inf, np.float32)
        triangle = np.full(len(rays), -1, np.int64)
        first = 0
        for layer in layers:
            answer = layer.scene.cast_rays(o3d.core.Tensor(rays), nthreads=1)
            t_layer, ids = answer["t_hit"].numpy(), answer["primitive_ids"].numpy()
            nearer = (t_layer < t) & (ids != _MISS)
            np.copyto(t, t_layer, where=nearer)
            np.copyto(triangle, ids.astype(np.int64) + first, where=nearer)
            first += len(layer.rows)
        return t, triangle, rays[:, 3:]

    def _shade(self, tables: _Tables, hits: _Hits, exposed: _Exposed) -> Floats:
        """Colours (N, 3), black where nothing is hit.

        The footprint of a pixel in the texture is exact: with p = o + t d on the plane of normal
        n, dp/dx = t (D - d (n.D)/(n.d)) for the change D of the ray d from pixel to pixel.
        Four bilinear look-ups, one for each quarter of the pixel, filter it; their mip levels are
        rounded at four thresholds, so that their mean blends the levels.
        """
        t, triangle, d = hits
        rows = np.ascontiguousarray(tables[0].take(triangle, axis=0, mode="clip").T)
        texture = tables[1].take(triangle, mode="clip")
        t = np.where(triangle >= 0, t, 1).astype(np.float32)
        A, n, d = rows[:12].reshape(3, 4, -1), rows[12:15], np.ascontiguousarray(d.T)
        R, origin = exposed
        points = origin + t * d
        value = [_product(a[:3], points) + a[3] for a in A]
        slope = _product(n, d)
        n = n * -np.sign(slope)
        slope = np.where(np.abs(slope) < 1e-3, np.float32(1e-3), -np.abs(slope))
        steps = []
        for axis, focal in ((0, self._camera.fx), (1, self._camera.fy)):
            D = R[:, axis] / np.float32(focal)
            move = t * (D - d * (_product(D, n) / slope))
            steps.append([_product(a[:3], move) for a in A[:2]])
        sizes = self._atlas.sizes.T.take(texture, axis=1)
        texels = np.maximum(*(_longer(step, sizes) for step in steps))
        level = np.log2(np.maximum(texels / 2, np.float32(1e-3)))
        colour = np.zeros((len(t), 3), np.float32)
        for a, b, round_up in _QUARTERS:
            uv = [
                where + np.float32(a) * right + np.float32(b) * down
                for where, right, down in zip(value, *steps, strict=False)
            ]
            colour += sample(self._atlas, texture, uv, level + np.float32(round_up))
        colour *= 0.25 * value[2][:, None]
        colour[triangle < 0] = 0
        return colour


_Tables = tuple[Floats, NDArray[np.int32], NDArray[np.int32]]
_Hits = tuple[Floats, Ints, Floats]
_Exposed = tuple[Floats, Floats]


def _when_exposed(T_world_camera: Array, pixels: Floats) -> _Exposed:
    """Rotations (3, 3, N) and positions (3, N) when pixels (N, 2) are seen; N is 1 if at once."""
    T = T_world_camera.astype(np.float32)
    if T.ndim == 2:
        return T[:3, :3, None], T[:3, 3, None]
    T = T.transpose(1, 2, 0).take(np.rint(pixels[:, 1]).astype(int), axis=2)
    return T[:3, :3], T[:3, 3]


def _product(a: NDArray[Any], b: NDArray[Any]) -> Floats:
    """The inner products (N,) of vectors in columns, (3, N): quicker than of rows."""
    found: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return found


def _facing(normals: Floats, rays: Floats) -> tuple[Floats, Floats]:
    """Normals (N, 3) turned against the rays (N, 3), and the products (N,) before the turn."""
    slope = np.einsum("nj,nj->n", normals, rays)
    return normals * -np.sign(slope)[:, None], slope


def _stack(static: Geometry, moving: Geometry | None) -> tuple[list[Geometry], _Tables]:
    """The layers, and their tables one after another."""
    if moving is None:
        return [static], (static.rows, static.texture, static.instance)
    layers = [static, moving]
    return layers, (
        np.concatenate([layer.rows for layer in layers]),
        np.concatenate([layer.texture for layer in layers]),
        np.concatenate([layer.instance for layer in layers]),
    )


def _longer(step: list[Floats], sizes: Floats) -> Floats:
    """The longer side (N,) in texels of steps, two of (N,), in textures of ``sizes`` (2, N)."""
    longer: Floats = np.maximum(*(np.abs(s * size) for s, size in zip(step, sizes, strict=True)))
    return longer


def _edges(texture: NDArray[np.integer], depth_m: Floats, rgb: Floats) -> Mask:
    """Pixels beside another surface, or a jump in depth, of another colour, (H, W)."""
    edges = np.zeros(texture.shape, bool)
    grey = rgb[..., 1] + 0.5 * (rgb[..., 0] + rgb[..., 2])
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        jump = np.abs(depth_m[a] - depth_m[b]) > 0.05 * np.minimum(depth_m[a], depth_m[b])
        contrast = np.abs(grey[a] - grey[b]) > 2 * _EDGE_CONTRAST
        change = ((texture[a] != texture[b]) | jump) & contrast
        edges[a] |= change
        edges[b] |= change
    return edges


def to_image(picture: Floats) -> Image:
    """Round and clip to 8 bits."""
    return np.clip(picture + 0.5, 0, 255).astype(np.uint8)
