"""A frame as the volume takes it: planes, weights and truncation of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Array, Floats, Image, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.backprojection import surface_normals
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.surface.pixel_planes import WITNESS, paint_of_pixels, planes_of_pixels

BEHIND_VOXELS, RIM_BEHIND_VOXELS = (3, 8), 2
"""How far behind the surface distances count: at least and at most, and at rims."""
SILHOUETTE_PX = 3
"""Silhouettes of depth are not exact to a pixel."""
PAINT_PX = 8
"""Colours so near to a rim or hole, which may be those of what is in front, hardly count."""
DARKEST, BRIGHTEST = 16.0, 240.0
"""Colours beyond these are cut off by the camera, or noise."""
MIN_PIXELS, MAX_GAIN = 100, 2.5
PULL = 0.95
"""Share of a difference that is made up for: else errors of the gains would add up on the way."""
UNEXPLAINED = 0.0875
"""How much a frame counts as a witness of a surface that the keyframes did not see: twelve are
needed for one."""


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """What a frame's pixels tell about the distance to the surface.

    Attributes:
        pixels: (H W, 8) float32. NX, NY, NZ: unit normal towards the camera, in its frame; OFFSET:
            normal . p of the pixel's point p, in metres; WEIGHT: 1 / sigma^2 of a distance in
            1/cm^2, 0 where the pixel tells nothing; Z: depth in metres, 0 without weight; BEHIND:
            how far behind the surface distances still count, in metres; WITNESS: see UNEXPLAINED.
        free_m: (H W,) float32, depth up to which all rays around the pixel are free; 0: not known.
        paint: (H W, 4) float32, colours from 0 to 255 and the weight that they have.
        T_world_camera: (4, 4).
    """

    pixels: Tensor
    free_m: Tensor
    paint: Tensor
    T_world_camera: Array


def depth_frame(
    measured: InverseDepthMap, rgb: Image, T_world_camera: Array, camera: Camera, voxel_m: float
) -> DepthFrame:
    """A frame from its inverse depth and colours (H, W, 3), for a volume of this voxel size.

    A voxel's distance is that to the plane of the pixel on which it falls: normal . (q - p), which
    unlike a difference of depths has no bias on a slope and none by rounding to a pixel. Its
    variance is (sigma_z cos(angle))^2 + MIN_VARIANCE_M2. Beside steps of depth and holes, where a
    sensor's depth may be of neither side, a pixel counts RIM, on the plane of a neighbour, or not.
    """
    rho, shape = measured.rho.numpy(), measured.rho.shape
    normals = surface_normals(measured, camera).numpy()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    behind_m = [voxel_m * voxels for voxels in (*BEHIND_VOXELS, RIM_BEHIND_VOXELS)]
    pixels, paint = np.empty((*shape, 8), np.float32), np.empty((rho.size, 4), np.float32)
    known_m, inner_m, sight = (np.empty(shape, np.float32) for _ in range(3))
    planes_of_pixels(
        (rho, measured.variance.numpy(), normals),
        tuple(map(np.float32, intrinsics)),
        tuple(map(np.float32, behind_m)),
        (pixels, known_m, inner_m, sight),
    )
    clear = _least_around(inner_m, PAINT_PX) > 0
    paint_of_pixels(rgb.reshape(-1, 3), clear.reshape(-1), sight.reshape(-1), paint)
    free_m = _least_around(known_m, SILHOUETTE_PX).reshape(-1)
    planes, free, colours = map(torch.from_numpy, (pixels.reshape(-1, 8), free_m, paint))
    return DepthFrame(planes, free, colours, T_world_camera)


def _least_around(values: Floats, radius: int) -> Floats:
    """The least value (H, W) in the square around each pixel."""
    return np.asarray(cv2.erode(values, np.ones((2 * radius + 1,) * 2, np.uint8)), np.float32)


def mark_unexplained(frame: DepthFrame, unexplained: Mask) -> None:
    """Let pixels (H, W) count less as witnesses, in place."""
    frame.pixels[torch.from_numpy(unexplained.reshape(-1)), WITNESS] = UNEXPLAINED


def gains(seen: Tensor, known: Tensor) -> Tensor:
    """Factors (3,) of red, green and blue for a frame, so that it looks as the surface does.

    ``seen`` (N, 3) are colours of pixels of the frame, ``known`` (N, 4) those of the surface there
    and their weights. gain = (median of known / seen)^PULL, at most MAX_GAIN either way; 1 where
    too few are known. Colours are sRGB, about light^(1 / 2.2): a factor of the light is one of them
    too.
    """
    inside = (known[:, 3] > 0) & (seen >= DARKEST).all(1) & (seen <= BRIGHTEST).all(1)
    inside &= (known[:, :3] >= DARKEST).all(1) & (known[:, :3] <= BRIGHTEST).all(1)
    if int(inside.sum()) < MIN_PIXELS:
        return torch.ones(3)
    ratio = known[inside, :3] / seen[inside]
    return ratio.median(0).values.pow(PULL).clamp(1 / MAX_GAIN, MAX_GAIN)
