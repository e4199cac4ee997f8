"""Model of a Kinect: depth noise, holes and quantisation; exposure and motion blur of colour."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Mask
from bmask_slam.graph.camera import Camera

RANGE_M = (0.5, 5.0)
"""Range of depth that is measured."""
GRAZING_COSINE = 0.17
"""Surfaces seen at less than about 10 degrees return nothing."""
_JITTER_PX = 0.35
_STEPS_PER_PX = 8.0
_SHADOW_PX = 0.75


def depth_sigma_m(depth_m: NDArray[Any]) -> NDArray[Any]:
    """Standard deviation of a Kinect's depth in metres (Nguyen et al. 2012, axial noise)."""
    return 0.0012 + 0.0019 * (depth_m - 0.4) ** 2


def measure_depth(
    depth_m: Floats, normals: Floats, camera: Camera, rng: np.random.Generator
) -> Floats:
    """The depth (H, W) that a Kinect would measure: float32, NaN where it measures none.

    Disparity bf/z is read at a position that is off by a fraction of a pixel, gets noise that is
    correlated between neighbouring pixels, and is rounded to an eighth of a pixel. Missing: out of
    range, grazing, in the projector's shadow, and a ragged rim along edges.
    """
    h, w = depth_m.shape
    missing = ~((depth_m >= RANGE_M[0]) & (depth_m <= RANGE_M[1]))
    missing |= _grazing(normals, camera, rng) | _in_shadow(depth_m, camera)
    missing |= _ragged(depth_m, rng)
    v, u = np.mgrid[:h, :w].astype(np.float32)
    where = _smooth_noise((2, h, w), 3.0, rng) * np.float32(_JITTER_PX)
    read = cv2.remap(
        np.nan_to_num(depth_m, nan=0.0), u + where[0], v + where[1],
        cv2.INTER_NEAREST, None, cv2.BORDER_REPLICATE,
    )  # fmt: skip
    # Within a surface the offset moves along its plane; across an edge nothing is interpolated.
    smooth = cv2.remap(
        depth_m, u + where[0], v + where[1], cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE
    )
    read = np.where(np.abs(smooth - read) < 0.02 * read, smooth, read)
    read = np.maximum(read, np.float32(0.1))
    bf = np.float32(camera.stereo_bf_px_m)
    noise = _smooth_noise((h, w), 0.8, rng) * depth_sigma_m(read) * bf / read**2
    disparity = np.round(_STEPS_PER_PX * (bf / read + noise)) / _STEPS_PER_PX
    measured = bf / np.maximum(disparity, np.float32(1.0))
    measured[missing] = np.nan
    return measured.astype(np.float32)


def _smooth_noise(shape: tuple[int, ...], sigma_px: float, rng: np.random.Generator) -> Floats:
    """Gaussian noise of unit variance, correlated over ``sigma_px``."""
    white = rng.standard_normal(shape, dtype=np.float32)
    planes = white.reshape(-1, *shape[-2:])
    size = 2 * int(3 * sigma_px) + 1
    gain = 1 / (cv2.getGaussianKernel(size, sigma_px) ** 2).sum()
    smooth = [cv2.GaussianBlur(plane, (size, size), sigma_px) for plane in planes]
    return (np.stack(smooth) * np.float32(gain)).reshape(shape)


def _grazing(normals: Floats, camera: Camera, rng: np.random.Generator) -> Mask:
    """Pixels (H, W) of surfaces at too flat an angle; the limit has a random part."""
    h, w = normals.shape[:2]
    v, u = np.mgrid[:h, :w].astype(np.float32)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    cosine = np.abs((normals * rays).sum(-1)) / np.linalg.norm(rays, axis=-1)
    limit = GRAZING_COSINE * (1 + 0.35 * _smooth_noise((h, w), 2.0, rng))
    grazing: Mask = cosine < limit
    return grazing


def _in_shadow(depth_m: Floats, camera: Camera) -> Mask:
    """Pixels (H, W) whose surface is hidden from the projector, a baseline to the right.

    A pixel's column in the projector is u - bf/z. It is hidden where a pixel further to the right
    has a smaller column: that surface is nearer and blocks the light.
    """
    u = np.arange(depth_m.shape[1], dtype=np.float32)
    column = u - np.float32(camera.stereo_bf_px_m) / np.nan_to_num(depth_m, nan=1e3)
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden: Mask = column > nearest + _SHADOW_PX
    return hidden


def _ragged(depth_m: Floats, rng: np.random.Generator) -> Mask:
    """Pixels (H, W) of a random rim, about a pixel wide, along jumps in depth."""
    z = np.nan_to_num(depth_m, nan=0.0)
    jump = cv2.dilate(z, np.ones((3, 3))) - cv2.erode(z, np.ones((3, 3))) > 0.05 * np.maximum(
        z, 0.3
    )
    rim = cv2.dilate(jump.astype(np.uint8), np.ones((3, 3))) > 0
    chance = rng.random(z.shape, dtype=np.float32)
    return (jump & (chance < 0.75)) | (rim & (chance < 0.35))


def exposure_gain(time_s: float, seed: int) -> float:
    """A slow change of brightness between about 0.7 and 1.3."""
    phase = np.random.default_rng([seed, 11]).uniform(0, 2 * np.pi, 2)
    return float(
        1
        + 0.2 * np.sin(2 * np.pi * time_s / 9 + phase[0])
        + 0.1 * np.sin(2 * np.pi * time_s / 3.7 + phase[1])
    )


def optical_flow(depth_m: Floats, camera: Camera, T_b_a: Array) -> Floats:
    """Motion (H, W, 2) in pixels of the static surface seen at frame a, to frame b."""
    h, w = depth_m.shape
    v, u = np.mgrid[:h, :w].astype(float)
    pixels = np.stack([u, v], -1)
    z = np.nan_to_num(depth_m.astype(float), nan=5.0)
    points = camera.backproject(pixels, z) @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    points[..., 2] = np.maximum(points[..., 2], 0.05)
    return (camera.project(points) - pixels).astype(np.float32)


def blur(rgb: Floats, flow_px: Floats, samples: int = 7) -> Floats:
    """The mean of the picture moved along ``flow_px`` (H, W, 2), from minus to plus one half."""
    h, w = rgb.shape[:2]
    v, u = np.mgrid[:h, :w].astype(np.float32)
    total = np.zeros_like(rgb)
    for s in np.linspace(-0.5, 0.5, samples, dtype=np.float32):
        total += cv2.remap(
            rgb, u + s * flow_px[..., 0], v + s * flow_px[..., 1],
            cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE,
        )  # fmt: skip
    return (total / samples).astype(np.float32)
