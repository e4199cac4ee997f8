"""Small exact scenes for the tests of the mapping layer, and simple reference methods."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import torch

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap

CAMERA = Camera(40, 30, fx=38.0, fy=39.0, cx=19.2, cy=14.7, stereo_bf_px_m=3.0)


def plane_rho(T_world_camera, normal=(0.2, -0.1, 1.0), offset_m=2.0, camera=CAMERA):
    """Inverse depth (H, W) at which each pixel's ray meets the plane n x = offset of the world."""
    n_camera = T_world_camera[:3, :3].T @ np.array(normal)
    distance = offset_m - np.dot(normal, T_world_camera[:3, 3])
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)
    return rays @ n_camera / distance


def as_map(rho, sigma) -> InverseDepthMap:
    """A map of rho (H, W) and sigma, a number or (H, W); unknown where rho is NaN."""
    rho = np.asarray(rho, float)
    variance = np.where(np.isfinite(rho), np.square(sigma) * np.ones_like(rho), np.nan)
    return InverseDepthMap(
        torch.tensor(rho, dtype=torch.float32), torch.tensor(variance, dtype=torch.float32)
    )


def noisy_map(rng, T_world_camera, sigma=0.004, missing=0.15, step=0.3) -> InverseDepthMap:
    """A plane with a nearer block on it, noise, holes and some outliers."""
    rho = plane_rho(T_world_camera)
    rho[8:17, 10:22] += step
    sigmas = sigma * rng.uniform(0.7, 1.5, rho.shape)
    rho += rng.normal(0, sigmas)
    wrong = rng.random(rho.shape) < 0.03
    rho[wrong] *= rng.uniform(0.6, 1.6, wrong.sum())
    rho[rng.random(rho.shape) < missing] = np.nan
    rho[20:26, 28:36] = np.nan
    return as_map(rho, sigmas)


def poses(rng, count, angle_rad=0.03, shift_m=0.08):
    """T_world_camera of keyframes near each other."""
    xi = rng.normal(0, [angle_rad] * 3 + [shift_m] * 3, (count, 6))
    return [make_pose(np.eye(3), np.array([0.1, 0.0, -0.2])) @ se3_exp(x) for x in xi]


def relative(T_world_own, T_world_other):
    """T_own_other."""
    return inverse(T_world_own) @ T_world_other


def largest_set(rho, variance):
    """Indices of the largest set of two or more mutually compatible estimates, by trying all."""
    usable = [k for k in range(len(rho)) if np.isfinite(rho[k]) and np.isfinite(variance[k])]
    for size in range(len(usable), 1, -1):
        for chosen in combinations(usable, size):
            if all(compatible(rho, variance, i, j) for i, j in combinations(chosen, 2)):
                return list(chosen)
    return []


def compatible(rho, variance, i, j):
    """The test of the paper, with chi-square at 95 % and 2 degrees of freedom."""
    d2 = (rho[i] - rho[j]) ** 2
    return d2 / variance[i] + d2 / variance[j] < 5.99


def weighted(rho, variance, chosen):
    """Paper eq. (7) and (8), corrected."""
    total = sum(rho[k] / variance[k] for k in chosen)
    return total / sum(1 / variance[k] for k in chosen)
