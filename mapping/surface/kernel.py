"""The inner loop of the surface volume, compiled by numba: a frame's part in each of its voxels."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints
from bmask_slam.mapping.compiled import compiled
from bmask_slam.mapping.surface.pixel_planes import (
    BEHIND,
    NX,
    NY,
    NZ,
    OFFSET,
    ONE,
    WEIGHT,
    WITNESS,
    Z,
)

HALF_MAX = np.float32(6e4)
"""Weights of colours are cut off here, below the largest float16."""
MANY, HALF = np.float32(2048), np.float32(0.5)
"""So many frames are counted: of more a float16 cannot tell one. Then both counts are halved, so
that what comes after counts more."""
NEAREST_M = 0.1
Places = tuple[Floats, Floats]
"""(N, 3) the first voxels of bricks in the camera, and (V, 3) a brick's voxels from there, m."""
View = tuple[float, float, float, float, int, int]
"""fx, fy, cx, cy, width and height of a camera, in pixels."""
Images = tuple[Floats, Floats, Floats, tuple[float, float, float]]
"""pixels (H W, 8), free_m (H W,) and paint (H W, 4) of a ``DepthFrame``, and factors of its red,
green and blue."""
Reach = tuple[float, float, float, float]
"""Edge of a voxel, where distances in front are cut off, how near voxels take colour, all in
metres, and the share of a ray's free depth that is kept."""
Tables = tuple[Floats, Floats, Array, Array, Array]
"""Distance and weight (B, V) as float32, witnesses, free (B, V) and colour (B, V, 4) as the bits of
float16, of all bricks."""
_LEAST_NORMAL, _EXPONENTS = np.uint32(0x38800000), np.uint32(0x38000000)
"""The least float32 that is a normal float16, and what the exponents of the two differ by, bits."""
_NORMAL, _SHIFT, _ROUND, _LAST = 0x400, np.uint32(13), np.uint32(0xFFF), np.uint32(1)
_SMALL = np.float32(1 << 24)


@compiled
def half_bits(value: float) -> np.uint16:
    """The float16 nearest to a float32 from 0 to HALF_MAX, as bits; of two the even one."""
    bits = np.float32(value).view(np.uint32)
    if bits < _LEAST_NORMAL:
        return np.uint16(np.rint(value * _SMALL))
    return np.uint16((bits - _EXPONENTS + _ROUND + ((bits >> _SHIFT) & _LAST)) >> _SHIFT)


@compiled
def half_value(bits: np.uint16) -> np.float32:
    """The value of a float16 >= 0, by its bits."""
    if bits < _NORMAL:
        return np.float32(bits) / _SMALL
    return np.uint32((np.uint32(bits) << _SHIFT) + _EXPONENTS).view(np.float32)


@compiled
def blended(bits: np.uint16, colour: float, share: float) -> np.uint16:
    """A mean, as the bits of a float16, moved by a share of the way to a colour."""
    mean = half_value(bits)
    return half_bits(mean + share * (colour - mean))


@compiled
def count_more(counts: Array, others: Array, at: tuple[int, int], more: float) -> None:
    """Add to a voxel's count, as the bits of a float16; ``others`` is compared with it."""
    b, k = at
    total = half_value(counts[b, k]) + more
    if total > MANY:
        total *= HALF
        others[b, k] = half_bits(half_value(others[b, k]) * HALF)
    counts[b, k] = half_bits(total)


@compiled
def pixel_at(x: float, y: float, z: float, view: View) -> int:
    """Index of the pixel on which a point of the camera falls; -1 outside the image."""
    fx, fy, cx, cy, width, height = view
    if z <= NEAREST_M:
        return -1
    rho = ONE / z
    u, v = np.rint(x * rho * fx + cx), np.rint(y * rho * fy + cy)
    if u < 0 or u >= width or v < 0 or v >= height:
        return -1
    return int(v) * width + int(u)


@compiled
def add_to_brick(
    brick: tuple[int, int], places: Places, view: View, images: Images, reach: Reach, tables: Tables
) -> None:
    """``add_frame`` for one of its bricks: its number n among them, and its row in the tables."""
    n, b = brick
    (corners, offsets), (pixels, free_m, paint, gain) = places, images
    voxel_m, front, near, kept = reach
    distance, weight, witnesses, free, colour = tables
    first_x, first_y, first_z = corners[n, 0], corners[n, 1], corners[n, 2]
    for k in range(len(offsets)):
        x, y, z = first_x + offsets[k, 0], first_y + offsets[k, 1], first_z + offsets[k, 2]
        p = pixel_at(x, y, z, view)
        if p < 0:
            continue
        if z < free_m[p] * kept - front:
            count_more(free, witnesses, (b, k), ONE)
        behind, w = pixels[p, BEHIND], pixels[p, WEIGHT]
        d = pixels[p, NX] * x + pixels[p, NY] * y + pixels[p, NZ] * z - pixels[p, OFFSET]
        if w <= 0 or d <= -behind or z >= pixels[p, Z] + behind + behind:
            continue
        d = min(d, front)
        added = w if d > -voxel_m else w * (d + behind) / (behind - voxel_m)
        total = weight[b, k] + added
        weight[b, k] = total
        distance[b, k] += added / total * (d - distance[b, k])
        if abs(d) < near:  # written out, which is a third faster than a loop over the colours
            count_more(witnesses, free, (b, k), pixels[p, WITNESS])
            added = w * paint[p, 3]
            total = half_value(colour[b, k, 3]) + added
            share = added / total
            colour[b, k, 0] = blended(colour[b, k, 0], gain[0] * paint[p, 0], share)
            colour[b, k, 1] = blended(colour[b, k, 1], gain[1] * paint[p, 1], share)
            colour[b, k, 2] = blended(colour[b, k, 2], gain[2] * paint[p, 2], share)
            colour[b, k, 3] = half_bits(min(total, HALF_MAX))


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
