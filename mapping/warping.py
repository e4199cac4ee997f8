"""How one keyframe's inverse-depth map looks from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from graph.camera import Camera
from graph.geometry import Array, inverse
from mapping.inverse_depth import InverseDepthMap

MAX_APART_PX = 1.0
"""A neighbour's point farther from the pixel's ray is another point."""
JUMP_SIGMAS = 3.0
"""Four pixels are one surface where interpolation stays within so many sigmas of the nearest."""


@dataclass(frozen=True, eq=False)
class View:
    """A neighbouring keyframe.

    Attributes:
        map: its inverse depth.
        T_own_neighbour: (4, 4), its pose seen from the keyframe.
        image: (3, H, W) float32 colours 0 to 255, or None.
    """

    map: InverseDepthMap
    T_own_neighbour: Array
    image: Tensor | None = None


def hypothesis(
    seeds: Tensor, view: View, camera: Camera, inner: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """What a neighbour says of the points at inverse depth ``seeds`` (H, W) on each pixel's ray.

    Each point is projected into the neighbour, whose rho and sigma there are mapped back as
    {rho + sigma, rho, rho - sigma} to p1, p2, p3: the mean p2 (H, W) and the variance
    max(|p1 - p2|, |p3 - p2|)^2 (H, W), NaN where it says nothing. At pixels of ``inner`` (H, W)
    only the inside of a surface counts: its last pixels reach up to half a pixel beyond its rim.
    """
    columns, rows = image_grid(seeds)
    u, v, ahead = project(seeds, inverse(view.T_own_neighbour), camera, (columns, rows))
    rho, variance = _sampled(view.map, u, v, inner)
    sigma = variance.sqrt_()
    forward, t_z = _depth_row(view.T_own_neighbour, camera)
    ray = forward[0] * u + forward[1] * v + forward[2]
    p1, p2, p3 = (r / (ray + t_z * r) for r in (rho + sigma, rho, rho - sigma))
    back_u, back_v, behind = project(rho, view.T_own_neighbour, camera, (u, v))
    apart = (back_u - columns).square_() + (back_v - rows).square_()
    usable = ahead & behind & (apart < MAX_APART_PX**2) & (rho > sigma)
    spread = torch.maximum((p1 - p2).abs_(), (p3 - p2).abs_()).square_()
    missing = torch.full_like(p2, torch.nan)
    return torch.where(usable, p2, missing), torch.where(usable, spread, missing)


def project(
    rho: Tensor, T_other_own: Array, camera: Camera, pixels: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Where points at inverse depth ``rho`` appear in another keyframe.

    ``pixels`` are their columns and rows, those of a whole image if not given. Returns columns and
    rows there, and whether they are in front of that camera.
    """
    if pixels is None:
        pixels = image_grid(rho)
    K = camera.K
    A = (K @ T_other_own[:3, :3] @ np.linalg.inv(K)).tolist()
    b = (K @ T_other_own[:3, 3]).tolist()
    x, y, w = ((pixels[0] * A[i][0] + A[i][2]) + pixels[1] * A[i][1] + rho * b[i] for i in range(3))
    return x.div_(w), y.div_(w), w > 0


def moved(
    rho: Tensor, T_other_own: Array, camera: Camera, pixels: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """The same points' inverse depth in the other keyframe, and d rho' / d rho."""
    forward, t_z = _depth_row(T_other_own, camera)
    ray = forward[0] * pixels[0] + forward[1] * pixels[1] + forward[2]
    depth = ray + t_z * rho
    return rho / depth, ray / depth**2


def image_grid(like: Tensor) -> tuple[Tensor, Tensor]:
    """Columns (1, W) and rows (H, 1) of an image's pixels."""
    height, width = like.shape
    columns = torch.arange(width, dtype=torch.float32, device=like.device)
    rows = torch.arange(height, dtype=torch.float32, device=like.device)
    return columns[None], rows[:, None]


def _depth_row(T_own_other: Array, camera: Camera) -> tuple[list[float], float]:
    """(a, t): a point at pixel p and inverse depth rho of the other has 1 / rho' = (a p + t rho)
    / rho in the own camera.
    """
    row = T_own_other[2, :3] @ np.linalg.inv(camera.K)
    return row.tolist(), float(T_own_other[2, 3])


def _sampled(
    view: InverseDepthMap, u: Tensor, v: Tensor, inner: Tensor | None
) -> tuple[Tensor, Tensor]:
    """rho and variance of a map at pixels (H, W), NaN outside.

    Inverse depth is linear in the image of a plane, so it is interpolated; where the pixels
    around are not one surface the nearest is taken, or none at pixels of ``inner`` (H, W).
    """
    height, width = view.rho.shape
    outside = (u < 0) | (v < 0) | (u > width - 1) | (v > height - 1)
    grid = torch.stack([u * (2 / (width - 1)) - 1, v * (2 / (height - 1)) - 1], dim=-1)[None]
    stack = torch.stack([view.rho, view.variance])[None]
    near, variance = grid_sample(stack, grid, "nearest", "border", align_corners=True)[0]
    between = grid_sample(stack[:, :1], grid, "bilinear", "border", align_corners=True)[0, 0]
    one_surface = (between - near).square() < JUMP_SIGMAS**2 * variance
    rho = torch.where(one_surface, between, near)
    if inner is not None:
        outside |= inner & ~one_surface
    return rho.masked_fill_(outside, torch.nan), variance.masked_fill_(outside, torch.nan)
