"""The planes of a frame's pixels, from a compiled loop, against the same rules in plain numpy."""

from __future__ import annotations

import numpy as np
from surface_scene import CAMERA, as_map, plane_rho, poses

from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.surface.depth_frame import depth_frame
from bmask_slam.mapping.surface.pixel_planes import (
    BEHIND,
    MIN_COSINE,
    MIN_VARIANCE_M2,
    NX,
    NZ,
    OFFSET,
    RIM,
    RIM_M,
    WEIGHT,
    Z,
)

VOXEL_M, SIGMA = 0.05, 0.002


def test_planes_are_those_of_plain_numpy() -> None:
    rng = np.random.default_rng(7)
    T = poses(rng, 1)[0]
    rho = plane_rho(T, np.array([0.2, -0.1, 1.0]), 2.0)
    rho[8:20, 10:22] = plane_rho(T, np.array([0.1, 0.3, 1.0]), 1.2)[8:20, 10:22]  # a thing in front
    rho[rng.random(rho.shape) < 0.03] = np.nan
    rho[15, 30] = 0.0  # infinitely far
    measured = as_map(rho, SIGMA)
    rgb = rng.integers(20, 230, (*rho.shape, 3), np.uint8)
    pixels = depth_frame(measured, rgb, T, CAMERA, VOXEL_M).pixels.numpy().reshape(*rho.shape, 8)

    points, normals = (
        back_project(measured, CAMERA).numpy(),
        surface_normals(measured, CAMERA).numpy(),
    )
    rims = np.isfinite(points[..., 2]) & ~np.isfinite(normals[..., 0])
    rims[[0, -1]] = rims[:, [0, -1]] = False
    extended = normals.copy()
    for v, u in np.argwhere(rims):
        beside = [(v + dy, u + dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        apart = np.array([abs((points[v, u] - points[at]) @ normals[at]) for at in beside])
        if np.nanmin([*apart, np.inf]) < RIM_M:
            extended[v, u] = normals[beside[int(np.nanargmin(apart))]]
    offset, z = (extended * points).sum(axis=-1), points[..., 2]
    cosine = -offset / np.linalg.norm(points, axis=-1)
    S = measured.variance.numpy() * (z**2 * cosine) ** 2 + MIN_VARIANCE_M2
    good = (cosine > MIN_COSINE) & np.isfinite(S)

    assert np.array_equal(pixels[..., WEIGHT] > 0, good)
    assert rims[good].sum() > 20 < (~rims)[good].sum() and not pixels[~good].any()
    weight = 1e-4 / S * np.where(rims, RIM, 1)
    behind_m = np.where(rims, 2 * VOXEL_M, np.clip(3 * np.sqrt(S), 3 * VOXEL_M, 8 * VOXEL_M))
    np.testing.assert_allclose(pixels[good][:, NX : NZ + 1], extended[good], atol=1e-5)
    for column, expected in ((OFFSET, offset), (Z, z), (WEIGHT, weight), (BEHIND, behind_m)):
        np.testing.assert_allclose(pixels[good][:, column], expected[good], rtol=1e-4)
