"""The inner loop of the surface volume, compiled by numba: a frame's part in each of its voxels."""

from __future__ import annotations

from collections.abc import Callable

import numba
import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.mapping.surface.depth_frame import (
    BEHIND,
    NX,
    NY,
    NZ,
    OFFSET,
    WEIGHT,
    WITNESS,
    Z,
)

HALVES: Floats = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)
"""The value of each float16, by its bits."""
HALF_MAX = 6e4
"""Weights of colours are cut off here, below the largest float16."""
NEAREST_M = 0.1
Places = tuple[Floats, Floats]
"""(N, 3) the first voxels of bricks in the camera, and (V, 3) a brick's voxels from there, m."""
View = tuple[float, float, float, float, int, int]
"""fx, fy, cx, cy, width and height of a camera, in pixels."""
Images = tuple[Floats, Floats, Floats]
"""pixels (H W, 8), free_m (H W,) and paint (H W, 4) of a ``DepthFrame``."""
Reach = tuple[float, float, float, float]
"""Edge of a voxel, where distances in front are cut off, how near voxels take colour, all in
metres, and the share of a ray's free depth that is kept."""
Tables = tuple[Floats, Floats, Array, Array, Array, Floats]
"""Distance and weight (B, V) as float32, witnesses, free (B, V) and colour (B, V, 4) as the bits of
float16, of all bricks; and HALVES."""
_LEAST_NORMAL, _EXPONENTS, _LEAST_SHARE = 0x38800000, 0x38000000, 1 << 24


def compiled(function: Callable) -> Callable:
    """The function compiled when it is first called; kept on disk where there is a place for it."""
    try:
        return numba.njit(cache=True, nogil=True)(function)
    except RuntimeError:  # neither beside the source nor in the user's cache
        return numba.njit(nogil=True)(function)


@compiled
def half_bits(value: float) -> np.uint16:
    """The float16 nearest to a float32 from 0 to HALF_MAX, as bits; of two the even one."""
    bits = np.float32(value).view(np.uint32)
    if bits < _LEAST_NORMAL:
        return np.uint16(np.rint(value * np.float32(_LEAST_SHARE)))
    return np.uint16((bits - _EXPONENTS + 0xFFF + ((bits >> 13) & 1)) >> 13)


@compiled
def blend(
    colour: Array, at: tuple[int, int], paint: Floats, pixel: int, weight: float, halves: Floats
) -> None:
    """Add the colour of a pixel, its weight times another one, to the mean of a voxel, in place."""
    b, k = at
    before, added = halves[colour[b, k, 3]], weight * paint[pixel, 3]
    share = added / (before + added)
    for c in range(3):
        old = halves[colour[b, k, c]]
        colour[b, k, c] = half_bits(old + share * (paint[pixel, c] - old))
    colour[b, k, 3] = half_bits(min(before + added, np.float32(HALF_MAX)))


@compiled
def pixel_at(x: float, y: float, z: float, view: View) -> int:
    """Index of the pixel on which a point of the camera falls; -1 outside the image."""
    fx, fy, cx, cy, width, height = view
    if z <= NEAREST_M:
        return -1
    u, v = np.rint(x / z * fx + cx), np.rint(y / z * fy + cy)
    if u < 0 or u >= width or v < 0 or v >= height:
        return -1
    return int(v) * width + int(u)


@compiled
def add_to_brick(
    brick: tuple[int, int], places: Places, view: View, images: Images, reach: Reach, tables: Tables
) -> None:
    """``add_frame`` for one of its bricks: its number n among them, and its row in the tables."""
    n, b = brick
    (corners, offsets), (pixels, free_m, paint) = places, images
    voxel_m, front, near, kept = reach
    distance, weight, witnesses, free, colour, halves = tables
    for k in range(len(offsets)):
        x, y = corners[n, 0] + offsets[k, 0], corners[n, 1] + offsets[k, 1]
        z = corners[n, 2] + offsets[k, 2]
        p = pixel_at(x, y, z, view)
        if p < 0:
            continue
        if z < free_m[p] * kept - front:
            free[b, k] = half_bits(halves[free[b, k]] + np.float32(1))
        behind, w = pixels[p, BEHIND], pixels[p, WEIGHT]
        d = pixels[p, NX] * x + pixels[p, NY] * y + pixels[p, NZ] * z - pixels[p, OFFSET]
        if w <= 0 or d <= -behind or z >= pixels[p, Z] + 2 * behind:
            continue
        d = min(d, front)
        added = w * min((d + behind) / (behind - voxel_m), np.float32(1))
        weight[b, k] += added
        distance[b, k] += added / weight[b, k] * (d - distance[b, k])
        if abs(d) < near:
            witnesses[b, k] = half_bits(halves[witnesses[b, k]] + pixels[p, WITNESS])
            blend(colour, (b, k), paint, p, w, halves)


@compiled
def add_frame(
    bricks: Ints, places: Places, view: View, images: Images, reach: Reach, tables: Tables
) -> None:
    """Add what a frame's pixels tell to the voxels of bricks, in place.

    Curless and Levoy (1996) eq. (5), (6): D = (W D + w d) / (W + w), W = W + w, with d the distance
    to the plane of the pixel on which the voxel falls. Up to a voxel behind the surface a distance
    counts fully, then less and less: what is behind a thin wall is its other side.

    ``bricks`` (N,) are rows of the tables.
    """
    for n in range(len(bricks)):
        add_to_brick((n, bricks[n]), places, view, images, reach, tables)
