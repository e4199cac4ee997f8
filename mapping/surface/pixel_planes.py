"""The plane of every pixel of a frame, in one loop over its pixels, compiled by numba."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Bytes, Floats, Mask
from bmask_slam.mapping.compiled import compiled

NX, NY, NZ, OFFSET, WEIGHT, Z, BEHIND, WITNESS = range(8)
"""Columns of ``DepthFrame.pixels``."""
MIN_COSINE = np.float32(0.15)
"""Pixels whose surface is seen at a flatter angle are left out."""
MIN_VARIANCE_M2 = np.float32(0.01**2)
"""Of the error of a distance beside that of its own pixel: of the pose and of the calibration."""
BEHIND_SIGMAS = np.float32(3)
RIM, RIM_M = np.float32(0.1), np.float32(0.01)
"""Weight of pixels beside a step of depth or a hole, which must be so near to the plane of a pixel
beside them."""
SIGHT = np.float32(0.05), np.float32(4)
"""Least and largest weight cos(angle) / z^2, in 1/m^2, of a view's colour."""
GLARE, FAINT = 250, np.float32(0.01)
"""Colours as bright as the camera can tell, and those beside rims and holes, count so little."""
PER_CM2 = np.float32(1e-4)
ONE = np.float32(1)
View = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""
Depth = tuple[Floats, Floats, Floats]
"""Inverse depth and its variance (H, W), and normals (H, W, 3), which may be NaN."""
Planes = tuple[Floats, Floats, Floats, Floats]
"""What is filled in: the pixels (H, W, 8); z (H, W) in metres, 0 where it is unknown; z without
rims and pixels that tell nothing, 0 there; and the weight (H, W) of the view's colour."""
Real = float | np.float32
Point = tuple[Real, Real, Real]


@compiled
def point_of(rho: Floats, v: int, u: int, view: View) -> Point:
    """The point of a pixel in the camera, in metres; of NaN or inf without depth."""
    fx, fy, cx, cy = view
    z = ONE / rho[v, u]
    return (np.float32(u) - cx) / fx * z, (np.float32(v) - cy) / fy * z, z


@compiled
def plane_beside(
    point: Point, at: tuple[int, int], rho: Floats, normals: Floats, view: View
) -> Point:
    """The normal of that of the eight pixels around on whose plane a point lies best, or NaN."""
    row, column = at
    best, found = RIM_M, (np.float32(np.nan), np.float32(np.nan), np.float32(np.nan))
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            v, u = row + dy, column + dx
            nx, ny, nz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            x, y, z = point_of(rho, v, u, view)
            apart = abs((point[0] - x) * nx + (point[1] - y) * ny + (point[2] - z) * nz)
            if apart < best:  # never where NaN
                best, found = apart, (nx, ny, nz)
    return found


@compiled
def planes_of_pixels(depth: Depth, view: View, behind_m: Point, made: Planes) -> None:
    """What the pixels of an image tell about the distance to the surface, see ``DepthFrame``.

    ``behind_m`` are the least and largest distance behind the surface that count, and that of rims.
    """
    rho, variance, normals = depth
    pixels, known_m, inner_m, sight = made
    height, width = rho.shape
    least_m, most_m, rim_m = behind_m
    for v in range(height):
        for u in range(width):
            x, y, z = point_of(rho, v, u, view)
            pixels[v, u, :] = 0
            known_m[v, u] = inner_m[v, u] = 0
            sight[v, u] = SIGHT[0]
            if not np.isfinite(z):
                continue
            known_m[v, u] = z
            nx, ny, nz = normals[v, u, 0], normals[v, u, 1], normals[v, u, 2]
            inside = 0 < v < height - 1 and 0 < u < width - 1
            is_rim = inside and not np.isfinite(nx)
            if is_rim:
                nx, ny, nz = plane_beside((x, y, z), (v, u), rho, normals, view)
            offset = nx * x + ny * y + nz * z
            cosine = -offset / np.sqrt(x * x + y * y + z * z)
            across = z * z * cosine
            S = variance[v, u] * across * across + MIN_VARIANCE_M2
            if cosine > 0:  # never where NaN
                sight[v, u] = min(max(cosine / (z * z), SIGHT[0]), SIGHT[1])
            if not (cosine > MIN_COSINE and np.isfinite(S)):
                continue
            pixels[v, u, NX], pixels[v, u, NY], pixels[v, u, NZ] = nx, ny, nz
            pixels[v, u, OFFSET], pixels[v, u, Z], pixels[v, u, WITNESS] = offset, z, ONE
            pixels[v, u, WEIGHT] = PER_CM2 / S * (RIM if is_rim else ONE)
            reach_m = min(max(BEHIND_SIGMAS * np.sqrt(S), least_m), most_m)
            pixels[v, u, BEHIND] = rim_m if is_rim else reach_m
            inner_m[v, u] = 0 if is_rim else z


@compiled
def paint_of_pixels(rgb: Bytes, clear: Mask, sight: Floats, paint: Floats) -> None:
    """Fill in colours (N, 4) with their weights, of which clear pixels (N,) have the ``sight``."""
    for p in range(len(paint)):
        glares = rgb[p, 0] >= GLARE or rgb[p, 1] >= GLARE or rgb[p, 2] >= GLARE
        paint[p, 0], paint[p, 1], paint[p, 2] = rgb[p, 0], rgb[p, 1], rgb[p, 2]
        paint[p, 3] = sight[p] * (ONE if clear[p] and not glares else FAINT)
