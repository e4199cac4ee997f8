"""A frame as the volume takes it: planes, weights and truncation of its pixels."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Array, Image, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap

MIN_COSINE = 0.15
"""Pixels whose surface is seen at a flatter angle are left out."""
MIN_SIGMA_M = 0.01
"""Error of a distance beside that of its own pixel: of the pose and of the sensor's calibration."""
BEHIND_SIGMAS, BEHIND_VOXELS = 3.0, (3, 8)
RIM, RIM_M, RIM_BEHIND_VOXELS = 0.1, 0.01, 2
"""Weight of pixels beside a step of depth or a hole, which must be so near to the plane of a pixel
beside them, and how far behind the surface they count."""
NEIGHBOURS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
SILHOUETTE_PX = 3
"""Silhouettes of depth are not exact to a pixel."""
PAINT_PX, GLARE, FAINT = 8, 250, 0.01
"""Colours so near to a rim or hole, which may be those of what is in front, and colours as bright
as the camera can tell, hardly count."""
SIGHT = (0.05, 4.0)
"""Least and largest weight cos(angle) / z^2, in 1/m^2, of a view's colour."""
DARKEST, BRIGHTEST = 16.0, 240.0
"""Colours beyond these are cut off by the camera, or noise."""
MIN_PIXELS, MAX_GAIN = 100, 2.5
PULL = 0.95
"""Share of a difference that is made up for: else errors of the gains would add up on the way."""
UNEXPLAINED = 0.0875
"""How much a frame counts as a witness of a surface that the keyframes did not see: twelve are
needed for one."""
NX, NY, NZ, OFFSET, WEIGHT, Z, BEHIND, WITNESS = range(8)
"""Columns of ``DepthFrame.pixels``."""


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
    variance is (sigma_z cos(angle))^2 + MIN_SIGMA_M^2. Beside steps of depth and holes, where a
    sensor's depth may be of neither side, a pixel counts RIM, on the plane of a neighbour, or not.
    """
    points = back_project(measured, camera)
    normals = surface_normals(measured, camera)
    rims = _extend(normals, points)
    offset, z = (normals * points).sum(-1), points[..., 2]
    cosine = -offset / torch.linalg.norm(points, dim=-1)
    variance = (measured.variance.sqrt() * z.square() * cosine).square() + MIN_SIGMA_M**2
    good = (cosine > MIN_COSINE) & torch.isfinite(variance)
    least, most = BEHIND_VOXELS
    behind_m = (BEHIND_SIGMAS * variance.sqrt()).clamp(least * voxel_m, most * voxel_m)
    columns = {
        OFFSET: offset,
        WEIGHT: torch.where(rims, RIM, 1.0) * 1e-4 / variance,
        Z: z,
        BEHIND: torch.where(rims, RIM_BEHIND_VOXELS * voxel_m, behind_m),
        WITNESS: torch.ones_like(z),
    }
    pixels = torch.empty((*z.shape, 8))
    pixels[..., :3] = normals
    for column, values in columns.items():
        pixels[..., column] = values
    pixels[~good] = 0
    pixels = pixels.reshape(-1, 8)
    inner = pixels[:, Z] * ~rims.reshape(-1)
    clear = _least_around(inner, z.shape, PAINT_PX) > 0
    sight = (cosine / z.square()).reshape(-1).nan_to_num_().clamp_(*SIGHT)
    free_m = _least_around(z.nan_to_num(), z.shape, SILHOUETTE_PX)
    return DepthFrame(pixels, free_m, _paint(rgb, clear, sight), T_world_camera)


def _paint(rgb: Image, clear: Tensor, sight: Tensor) -> Tensor:
    """Colours (H W, 4) with their weights, of which clear pixels (H W,) have the full ``sight``."""
    colours = torch.from_numpy(rgb).reshape(-1, 3).to(torch.float32)
    weight = sight * torch.where(clear & (colours < GLARE).all(1), 1, FAINT)
    return torch.cat([colours, weight[:, None]], 1)


def _least_around(values: Tensor, shape: torch.Size, radius: int) -> Tensor:
    """The least value (H W,) in the square around each pixel of an image of this shape."""
    square = np.ones((2 * radius + 1,) * 2, np.uint8)
    return torch.from_numpy(cv2.erode(values.reshape(shape).numpy(), square)).reshape(-1)


def mark_unexplained(frame: DepthFrame, unexplained: Mask) -> None:
    """Let pixels (H, W) count less as witnesses, in place."""
    frame.pixels[torch.from_numpy(unexplained.reshape(-1)), WITNESS] = UNEXPLAINED


def _extend(normals: Tensor, points: Tensor) -> Tensor:
    """Give points (H, W, 3) without a normal that of a neighbour on whose plane they lie, in place.

    Returns which they are (H, W): those beside a hole or a step of depth.
    """
    lone = torch.isfinite(points[..., 2]) & ~torch.isfinite(normals[..., 0])
    lone[[0, -1]] = lone[:, [0, -1]] = False
    rows, columns = torch.nonzero(lone).unbind(-1)
    own, best = points[rows, columns], torch.full((len(rows),), RIM_M)
    found = torch.full((len(rows), 3), torch.nan)
    for dy, dx in NEIGHBOURS:
        at = rows + dy, columns + dx
        normal = normals[at]
        apart = ((own - points[at]) * normal).sum(-1).abs()
        nearer = apart < best  # never where NaN
        best, found = torch.where(nearer, apart, best), torch.where(nearer[:, None], normal, found)
    normals[rows, columns] = found
    return lone


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
