"""What of a frame may be used: the keyframes' map, made without people, is the judge."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Array, Floats, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse

CELL_PX, CUBE_M, NEAREST_M = 8, 0.5, 0.1
IN_FRONT_M, IN_FRONT_SHARE = 0.05, 0.01
"""A pixel nearer than the keyframes' surface by this and this share of its depth is something that
was not there, or not allowed, in the keyframes."""
MARGIN_PX = 8


@dataclass(frozen=True, eq=False)
class Judgement:
    """Pixels (H, W) ``in_front`` of the keyframes' surface, and those where it is not known."""

    in_front: Mask
    unexplained: Mask


class KeyframeSurface:
    """The keyframes' surface as points, sorted into cubes of CUBE_M to find the visible ones."""

    def __init__(self, points_world: Floats, camera: Camera) -> None:
        """``points_world`` (N, 3), not farther apart than a cell of CELL_PX pixels."""
        index = np.floor(points_world / CUBE_M).astype(np.int64)
        cubes, which, counts = np.unique(index, axis=0, return_inverse=True, return_counts=True)
        order = np.argsort(which.reshape(-1), kind="stable")
        self._cubes = torch.split(torch.from_numpy(points_world[order]), counts.tolist())
        self._centres: Array = (cubes + 0.5) * CUBE_M
        self._camera = camera

    def judge(self, depth_m: Floats, T_world_camera: Array) -> Judgement:
        """Compare a frame's depth (H, W) with the surface as it looks from there."""
        nearest = self.nearest(T_world_camera)
        around = cv2.erode(np.pad(nearest, 1, "edge"), np.ones((3, 3), np.uint8))[1:-1, 1:-1]
        nearest = np.where(np.isfinite(nearest), nearest, around)
        full = np.kron(nearest, np.ones((CELL_PX, CELL_PX), np.float32))
        full = full[: self._camera.height, : self._camera.width]
        known = np.isfinite(full)
        in_front = known & (depth_m * (1 + IN_FRONT_SHARE) + IN_FRONT_M < full)
        edge = 2 * MARGIN_PX + 1
        grown = cv2.dilate(in_front.astype(np.uint8), np.ones((edge, edge), np.uint8))
        return Judgement(grown > 0, ~known)

    def nearest(self, T_world_camera: Array) -> Floats:
        """Depth of the nearest point on each cell of pixels, infinite where there is none."""
        camera = self._camera
        rows, columns = -(-camera.height // CELL_PX), -(-camera.width // CELL_PX)
        T_camera_world = inverse(T_world_camera)
        T = torch.from_numpy(T_camera_world).to(torch.float32)
        x, y, z = (self._visible(T_camera_world) @ T[:3, :3].T + T[:3, 3]).unbind(-1)
        u = ((x / z * camera.fx + camera.cx + 0.5) / CELL_PX).floor_()
        v = ((y / z * camera.fy + camera.cy + 0.5) / CELL_PX).floor_()
        inside = (z > NEAREST_M) & (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
        found = torch.full((rows * columns,), torch.inf)
        cell = v.mul_(columns).add_(u)[inside].to(torch.int64)
        found.scatter_reduce_(0, cell, z[inside], "amin")
        return np.asarray(found.reshape(rows, columns).numpy())

    def _visible(self, T_camera_world: Array) -> Tensor:
        """The points (N, 3) of the cubes that are in the image."""
        camera = self._camera
        x, y, z = (self._centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).T
        depth = np.maximum(z, NEAREST_M)
        margin = CUBE_M * camera.fx / depth
        u, v = x / depth * camera.fx + camera.cx, y / depth * camera.fy + camera.cy
        seen = (z > -CUBE_M) & (u > -margin) & (u < camera.width + margin)
        seen &= (v > -margin) & (v < camera.height + margin)
        parts = [self._cubes[k] for k in np.flatnonzero(seen).tolist()]
        return torch.cat(parts) if parts else torch.zeros((0, 3))
