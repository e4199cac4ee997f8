"""Synthetic views with exact truth: a textured plane rendered to frames, and bare keypoints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

CAMERA = Camera(640, 480, fx=525.0, fy=520.0, cx=318.5, cy=241.5)
HALF_CAMERA = Camera(320, 240, fx=262.5, fy=260.0, cx=159.25, cy=120.75, stereo_bf_px_m=15.0)
"""Sees every other pixel of every other row of ``CAMERA``."""
T_NEW_OLD = se3_exp(np.array([0.4, -1.1, 0.7, 3.0, -5.0, 2.0]))
PLANE_Z_M = 2.0
_TEXELS_PER_M = 250.0
_TEXTURE_HALF_M = 3.0


@cache
def plane_texture() -> Array:
    """(H, W) float32 grey levels of the plane, the same in every process."""
    rng = np.random.default_rng(11)
    side = int(2 * _TEXTURE_HALF_M * _TEXELS_PER_M)
    texture = np.zeros((side, side), np.float32)
    for sigma, weight in ((2.0, 1.0), (5.0, 2.0), (15.0, 3.0)):
        noise = cv2.GaussianBlur(rng.normal(size=(side, side)).astype(np.float32), (0, 0), sigma)
        texture += weight * noise / noise.std()
    return np.clip(128 + 22 * texture, 0, 255)


def render_plane(T_world_camera: Array, index: int = 0) -> Frame:
    """A camera's image of the plane z_world = 2 m, with exact depth.

    Poses (480, 4, 4) are those of the rows of a rolling shutter.
    """
    R, t = T_world_camera[..., :3, :3], T_world_camera[..., :3, 3, None]
    columns, rows = (
        (np.arange(640) - CAMERA.cx) / CAMERA.fx,
        (np.arange(480) - CAMERA.cy) / CAMERA.fy,
    )
    x, y, z = (
        R[..., axis, 0, None] * columns + (R[..., axis, 1] * rows + R[..., axis, 2])[:, None]
        for axis in range(3)
    )
    z_m = (PLANE_Z_M - t[..., 2, :]) / z
    u, v = (
        ((t[..., axis, :] + z_m * along + _TEXTURE_HALF_M) * _TEXELS_PER_M).astype(np.float32)
        for axis, along in enumerate((x, y))
    )
    image = cv2.remap(plane_texture(), u, v, cv2.INTER_LINEAR)
    rgb = cv2.cvtColor(np.rint(image).astype(np.uint8), cv2.COLOR_GRAY2RGB)
    return Frame(index, index / 30.0, rgb, z_m.astype(np.float32))


def render_half(T_world_camera: Array, index: int = 0) -> Frame:
    """`render_plane` by ``HALF_CAMERA``: a quarter of the pixels."""
    frame = render_plane(T_world_camera, index)
    half = np.s_[::2, ::2]
    return replace(frame, rgb=frame.rgb[half].copy(), depth_m=frame.depth_m[half].copy())


def render_or_black(T_world_camera: Array | None, index: int) -> Frame:
    """`render_plane`, or a black frame without depth for None."""
    if T_world_camera is not None:
        return render_plane(T_world_camera, index)
    black = np.zeros((480, 640, 3), np.uint8)
    return Frame(index, index / 30.0, black, np.full((480, 640), np.nan, np.float32))


class PlaneViews(Sequence[Frame]):
    """`render_or_black` of poses, each when it is first used: importing a test module is quick."""

    def __init__(self, poses: Sequence[Array | None]) -> None:
        self._poses = list(poses)
        self._frames: dict[int, Frame] = {}

    def __len__(self) -> int:
        return len(self._poses)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[k] for k in range(len(self))[which]]
        index = range(len(self))[which]
        if index not in self._frames:
            self._frames[index] = render_or_black(self._poses[index], index)
        return self._frames[index]


def sideways_path(x_m: Array) -> list[Array]:
    """Poses along x that turn a little about y and back."""
    return [se3_exp(np.array([0, 0.05 * np.sin(40 * x), 0, x, 0, 0])) for x in x_m]


def make_features(
    T_world_camera: Array, points_world: Array, descriptors: Array, noise_px: Array | None = None
) -> Features:
    """Keypoints that observe these points, in order; sigmas 0.7, 0.7 and 0.12 px."""
    points_camera = transform(inverse(T_world_camera), points_world)
    count = len(points_camera)
    noise_px = np.zeros((count, 3)) if noise_px is None else noise_px
    pixels = CAMERA.project(points_camera) + noise_px[:, :2]
    disparity = CAMERA.stereo_bf_px_m / points_camera[:, 2] + noise_px[:, 2]
    return Features(
        pixels=pixels,
        image_pixels=pixels.copy(),
        descriptors=descriptors,
        scales=np.ones(count),
        angles_rad=np.zeros(count),
        depth_m=CAMERA.stereo_bf_px_m / disparity,
        disparity_px=disparity,
        sigmas_px=np.tile([0.7, 0.7, 0.12], (count, 1)),
        colours=np.full((count, 3), 100, np.uint8),
        gray=np.zeros((480, 640), np.uint8),
    )


def random_descriptors(count: int, rng: np.random.Generator) -> Array:
    """(N, 8) uint64: two random ones are about 256 bits apart."""
    return rng.integers(0, 2**64, (count, 8), dtype=np.uint64)


def points_before(T_world_camera: Array, count: int, rng: np.random.Generator) -> Array:
    """Points (N, 3) in the world inside the view, 1 to 4 m away."""
    z = rng.uniform(1.0, 4.0, count)
    pixels = rng.uniform([60.0, 60.0], [580.0, 420.0], (count, 2))
    return transform(T_world_camera, CAMERA.backproject(pixels, z))


def add_keyframe(
    world: WorldMap, T_world_camera: Array, features: Features, segment: int = 0
) -> Keyframe:
    """Add a new keyframe without landmarks to the map."""
    keyframe_id = world.next_keyframe_id
    none = np.full(len(features), -1, np.int64)
    keyframe = Keyframe(
        keyframe_id, 10 * keyframe_id, keyframe_id / 3.0, segment, T_world_camera, features, none
    )
    world.add_keyframe(keyframe)
    return keyframe
