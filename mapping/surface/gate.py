"""What of a frame may be used: the keyframes' map, made without people, is the judge."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform

CELL_PX, CUBE_M, NEAREST_M = 8, 0.5, 0.1
IN_FRONT_M, IN_FRONT_SHARE = 0.05, 0.01
"""A pixel nearer than the keyframes' surface by this and this share of its depth is something that
was not there, or not allowed, in the keyframes."""
MARGIN_PX = 16


NEAR_VIEWS, MIN_VOTES, POINT_STEP_PX, SEEN_PX = 4, 2, 2, 3

DepthView = tuple[Floats, Array]
"""Depth (H, W) in metres, NaN where missing, and its T_world_camera (4, 4)."""


@dataclass(frozen=True, eq=False)
class Judgement:
    """Pixels (H, W) ``in_front`` of the keyframes' surface, and those where it is not known."""

    in_front: Mask
    unexplained: Mask


class _Unconfirmed:
    """Points (N, 3) that a view measured, and how many others see them, less those that do not."""

    def __init__(self, view: DepthView, points_world: Array) -> None:
        self.view, self.points_world = view, points_world
        self.votes: Ints = np.zeros(len(points_world), np.int64)

    def confirmed(self) -> Floats:
        return self.points_world[self.votes >= MIN_VOTES].astype(np.float32)


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
        self._all: Tensor | None = None

    @classmethod
    def near(cls, points_world: Floats, camera: Camera) -> KeyframeSurface:
        """One of points (N, 3) that all are near what is judged: they are not sorted."""
        found = cls(points_world[:0], camera)
        found._all = torch.from_numpy(points_world)
        return found

    def judge(self, depth_m: Floats, T_world_camera: Array) -> Judgement:
        """Compare a frame's depth (H, W) with the surface as it looks from there."""
        in_front, known = self._compare(depth_m, T_world_camera)
        edge = 2 * MARGIN_PX + 1
        grown = cv2.dilate(in_front.astype(np.uint8), np.ones((edge, edge), np.uint8))
        return Judgement(grown > 0, ~known)

    def _compare(self, depth_m: Floats, T_world_camera: Array) -> tuple[Mask, Mask]:
        """Pixels (H, W) in front of the surface, and those where it is known.

        Its nearest point on a cell of pixels and the cells around it counts: at the rim of a thing
        a cell may have points of what is behind alone.
        """
        nearest = np.pad(self.nearest(T_world_camera), 1, "edge")
        nearest = cv2.erode(nearest, np.ones((3, 3), np.uint8))[1:-1, 1:-1]
        full = np.kron(nearest, np.ones((CELL_PX, CELL_PX), np.float32))
        full = full[: self._camera.height, : self._camera.width]
        known = np.isfinite(full)
        return known & (_farther(depth_m) < full), known

    def seen_again(self, views: Iterable[DepthView]) -> Floats:
        """Points (N, 3) in front of the surface on which keyframes agree, such as legs of chairs.

        A keyframe may know too little of a thing for a surface. Of the ``NEAR_VIEWS`` before
        and after it in ``views``, MIN_VOTES more must see a point than see through it.
        """
        found, near = [np.zeros((0, 3), np.float32)], deque[_Unconfirmed]()
        for view in views:
            new = _Unconfirmed(view, self._in_front(*view))
            for other in near:
                other.votes += _votes(other.points_world, view, self._camera)
                new.votes += _votes(new.points_world, other.view, self._camera)
            near.append(new)
            if len(near) > NEAR_VIEWS:
                found.append(near.popleft().confirmed())
        return np.concatenate(found + [rest.confirmed() for rest in near])

    def _in_front(self, depth_m: Floats, T_world_camera: Array) -> Array:
        """Points (N, 3) in the world of every second pixel in front of the surface."""
        in_front, step = self._compare(depth_m, T_world_camera)[0], POINT_STEP_PX
        v, u = (step * a for a in np.nonzero(in_front[::step, ::step]))
        pixels, z = np.stack([u, v], axis=-1).astype(float), depth_m[v, u].astype(float)
        return transform(T_world_camera, self._camera.backproject(pixels, z))

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
        if self._all is not None:
            return self._all
        camera = self._camera
        x, y, z = (self._centres @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]).T
        depth = np.maximum(z, NEAREST_M)
        margin = CUBE_M * camera.fx / depth
        u, v = x / depth * camera.fx + camera.cx, y / depth * camera.fy + camera.cy
        seen = (z > -CUBE_M) & (u > -margin) & (u < camera.width + margin)
        seen &= (v > -margin) & (v < camera.height + margin)
        parts = [self._cubes[k] for k in np.flatnonzero(seen).tolist()]
        return torch.cat(parts) if parts else torch.zeros((0, 3))


def judge_of(points_world: Floats, views: Iterable[DepthView], camera: Camera) -> KeyframeSurface:
    """The surface of points (N, 3), and of what else the keyframes agree on, oldest first."""
    alone = KeyframeSurface(points_world, camera)
    return KeyframeSurface(np.concatenate([points_world, alone.seen_again(views)]), camera)


def _farther(depth_m: Floats) -> Floats:
    """Depth of what is certainly behind something."""
    return np.asarray(depth_m * (1 + IN_FRONT_SHARE) + IN_FRONT_M, np.float32)


def _votes(points_world: Array, view: DepthView, camera: Camera) -> Ints:
    """1 where a view sees points (N, 3), -1 where it sees through them, 0 where neither."""
    depth_m, T_world_camera = view
    points_camera = transform(inverse(T_world_camera), points_world)
    rows = np.flatnonzero(points_camera[:, 2] > NEAREST_M)
    pixels = np.rint(camera.project(points_camera[rows])).astype(np.int64)
    inside = ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(axis=1)
    rows, (u, v) = rows[inside], pixels[inside].T
    z, around = points_camera[rows, 2].astype(np.float32), np.ones((SEEN_PX, SEEN_PX), np.uint8)
    nearest, least = (
        cv2.erode(np.nan_to_num(depth_m, nan=missing), around)[v, u] for missing in (np.inf, 0)
    )
    votes = np.zeros(len(points_world), np.int64)
    votes[rows] = (nearest > 2 * z - _farther(z)) & (nearest < _farther(z))
    votes[rows[least > _farther(z)]] = -1
    return votes
