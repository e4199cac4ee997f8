"""Step 6: an inverse-depth map as points with normals in the camera's frame."""

from __future__ import annotations

import torch
from torch import Tensor

from graph.camera import Camera
from mapping.inverse_depth import InverseDepthMap
from mapping.warping import image_grid


def back_project(given: InverseDepthMap, camera: Camera) -> Tensor:
    """Points (H, W, 3) in metres by paper eq. (9), NaN where nothing is known.

    z = 1 / rho, x = (u - cx) z / fx, y = (v - cy) z / fy.
    """
    z = 1 / given.rho
    u, v = image_grid(z)
    x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
    return torch.stack([x, y, z], dim=-1)


def surface_normals(points: Tensor) -> Tensor:
    """Unit normals (H, W, 3) towards the camera of points (H, W, 3), by central differences.

    NaN at the border and where one of the four neighbours is missing.
    """
    normals = torch.full_like(points, torch.nan)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    n = torch.linalg.cross(down, across)
    normals[1:-1, 1:-1] = n / torch.linalg.norm(n, dim=-1, keepdim=True)
    return normals
