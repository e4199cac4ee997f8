"""One keyframe's inverse-depth map as seen from another keyframe."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.pixelwise import image_grid, nan_where_negative

MAX_APART_PX = 1.0
"""A neighbour's point that is farther from the pixel's ray is another point."""
JUMP_SIGMAS = 3.0
"""Four pixels are one surface if interpolation stays within so many sigmas of the nearest one."""


@dataclass(frozen=True, eq=False)
class View:
    """A neighbouring keyframe.

    Attributes:
        map: its inverse depth.
        T_own_neighbour: (4, 4), its pose in the frame of the keyframe.
        image: (3, H, W) float32 colours 0 to 255, or None.
    """

    map: InverseDepthMap
    T_own_neighbour: Array
    image: Tensor | None = None


def hypothesis(
    seeds: Tensor, view: View, camera: Camera, inner: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """A neighbour's estimate of the inverse depth of each pixel, mean (H, W) and variance (H, W).

    The point at inverse depth ``seeds`` (H, W) on the pixel's ray is projected into the neighbour,
    whose rho and sigma there are mapped back as {rho + sigma, rho, rho - sigma} to p1, p2, p3: the
    mean is p2 and the variance max(|p1 - p2|, |p3 - p2|)^2, NaN where the neighbour has no
    estimate. Where ``inner`` (H, W) is 1, not 0, only pixels inside a surface count, since those at
    its rim reach up to half a pixel beyond it.

    With w the ratio of seed and its inverse depth in the neighbour, (t_x, t_y, t_z) the
    neighbour's position, e = w rho - seed and d = 1 + t_z e, mapping back gives p2 = w rho / d,
    |p3 - p2| = w sigma |1 - t_z seed| / (d |d - |t_z| w sigma|), which is the greater for t_z > 0
    as |p1 - p2| is for t_z < 0, and the pixel is missed by e / d (K t - t_z pixel).
    """
    columns, rows = image_grid(seeds)
    u, v, w = project(seeds, inverse(view.T_own_neighbour), camera, (columns, rows))
    rho, sigma, margin = _sampled(view.map, u, v, inner)
    rho.mul_(w)
    sigma.mul_(w)
    b_x, b_y, t_z = (camera.K @ view.T_own_neighbour[:3, 3]).tolist()
    e = rho - seeds
    d = (t_z * e).add_(1)
    lever = (b_x - t_z * columns) ** 2 + (b_y - t_z * rows) ** 2
    margin = torch.minimum(margin, torch.minimum(d, rho - sigma))
    missed = e.square_().mul_(lever)
    usable = nan_where_negative(
        torch.minimum(margin, d.square().mul_(MAX_APART_PX**2).sub_(missed))
    )
    least = torch.sub(d, sigma, alpha=abs(t_z)).mul_(d)
    spread = (1 - t_z * seeds).mul_(sigma).div_(least).square_()
    return rho.div_(d).add_(usable), spread.add_(usable)


def project(
    rho: Tensor, T_other_own: Array, camera: Camera, pixels: tuple[Tensor, Tensor] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Project points at inverse depth ``rho`` into another keyframe.

    ``pixels`` are their columns and rows; None: all pixels of an image. Returns columns and rows in
    the other image, infinite or NaN behind that camera, and the ratio of rho to the inverse depth
    there, 0 behind it.
    """
    if pixels is None:
        pixels = image_grid(rho)
    K = camera.K
    A = (K @ T_other_own[:3, :3] @ np.linalg.inv(K)).tolist()
    b = (K @ T_other_own[:3, 3]).tolist()
    x, y, w = (
        (pixels[0] * A[i][0] + (pixels[1] * A[i][1] + A[i][2])).add_(rho, alpha=b[i])
        for i in range(3)
    )
    w.relu_()
    return x.div_(w), y.div_(w), w


def _sampled(
    view: InverseDepthMap, u: Tensor, v: Tensor, inner: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """rho and sigma of a map at pixels (H, W), and a margin (H, W), negative or NaN where unusable.

    Inverse depth is linear in the image of a plane, so it is interpolated; where the four pixels
    are not one surface the nearest is used, or none where ``inner`` (H, W) is 1.
    """
    height, width = view.rho.shape
    margin = torch.minimum(torch.minimum(u, width - 1 - u), torch.minimum(v, height - 1 - v))
    nearest = u.round().add_(v.round(), alpha=width).clamp_(0, height * width - 1)
    place = nearest.nan_to_num_().to(torch.int32).reshape(-1)
    near, sigma = (
        values.reshape(-1).index_select(0, place).reshape(u.shape)
        for values in (view.rho, view.variance)
    )
    sigma.sqrt_()
    grid = torch.empty((1, *u.shape, 2), device=u.device)
    grid[0, ..., 0] = u.mul_(2 / (width - 1)).sub_(1)
    grid[0, ..., 1] = v.mul_(2 / (height - 1)).sub_(1)
    between = grid_sample(view.rho[None, None], grid, "bilinear", "border", align_corners=True)
    jump = between[0, 0].sub_(near)
    one_surface = (JUMP_SIGMAS * sigma).sub_(jump.abs()).sign_().nan_to_num_().relu_()
    rho = near.addcmul_(jump.nan_to_num_(), one_surface)
    if inner is not None:
        margin = torch.minimum(margin, one_surface.sub_(inner))
    return rho, sigma, margin
