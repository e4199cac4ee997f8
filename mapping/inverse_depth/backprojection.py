"""Step 6: an inverse-depth map as points with normals in the camera's frame."""

from __future__ import annotations

import torch
from torch import Tensor

from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.pixelwise import image_grid, nan_where_negative, windowed

NORMAL_WINDOW_PX = 5
MAX_STEP = 0.05
"""Largest relative change of inverse depth over two pixels on one surface."""


def back_project(given: InverseDepthMap, camera: Camera) -> Tensor:
    """Points (H, W, 3) in metres by paper eq. (9), NaN where depth is unknown.

    z = 1 / rho, x = (u - cx) z / fx, y = (v - cy) z / fy.
    """
    z = 1 / given.rho
    u, v = image_grid(z)
    x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
    return _interleaved(x, y, z)


def surface_normals(given: InverseDepthMap, camera: Camera) -> Tensor:
    """Unit normals (H, W, 3) towards the camera.

    The image of a plane n x = d has rho = n K^-1 (u, v, 1) / d, so that its gradient (a, b) gives
    n ~ K^T (a, b, rho - a u - b v). The gradient is a mean of central differences over a window;
    unlike a mean of normals, it has no bias towards the camera under noise. NaN at the border,
    where one of the four neighbours is missing, and where they belong to different surfaces.
    """
    rho = given.rho
    inner = rho[1:-1, 1:-1]
    across, down = rho[1:-1, 2:] - rho[1:-1, :-2], rho[2:, 1:-1] - rho[:-2, 1:-1]
    steep = torch.maximum(across.abs(), down.abs())
    share = (MAX_STEP * inner).sub_(steep).sign_().nan_to_num_().relu_()
    a, b, weight = (
        windowed(torch.add, plane, NORMAL_WINDOW_PX // 2)
        for plane in (across.nan_to_num_() * share, down.nan_to_num_() * share, share)
    )
    weight = (0.5 / weight).add_(nan_where_negative(share - 1))
    a *= weight
    b *= weight
    u, v = image_grid(rho)
    u, v = u[:, 1:-1] - camera.cx, v[1:-1] - camera.cy
    planes = camera.fx * a, camera.fy * b, inner - a * u - b * v
    scale = (planes[0].square() + planes[1].square() + planes[2].square()).rsqrt_().neg_()
    normals = torch.full((*rho.shape, 3), torch.nan, device=rho.device)
    normals[1:-1, 1:-1] = _interleaved(*(plane.mul_(scale) for plane in planes))
    return normals


def _interleaved(*planes: Tensor) -> Tensor:
    """Planes (H, W) as one image (H, W, C), faster than `torch.stack`."""
    together = torch.empty((*planes[0].shape, len(planes)), device=planes[0].device)
    for k, plane in enumerate(planes):
        together[..., k] = plane
    return together
