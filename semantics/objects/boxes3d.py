"""Oriented boxes in space: around points, as corners, and how far two of them overlap."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Mask

MIN_SIZE_M = 0.01
_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
EDGES = np.array([(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1])
"""(12, 2) which corners are joined."""
_GRID = (np.stack(np.meshgrid(*3 * [np.arange(16)], indexing="ij"), -1).reshape(-1, 3) + 0.5) / 16


@dataclass(frozen=True, eq=False)
class OrientedBox:
    """A box in the world.

    Attributes:
        T_world_box: (4, 4), its centre and axes; the third axis is up.
        size_m: (3,) along its axes.
    """

    T_world_box: Array
    size_m: Array

    @property
    def corners_world(self) -> Array:
        """(8, 3); which are joined by an edge says EDGES."""
        corners = 0.5 * _SIGNS * self.size_m
        return corners @ self.T_world_box[:3, :3].T + self.T_world_box[:3, 3]

    @property
    def volume_m3(self) -> float:
        """Its volume."""
        return float(np.prod(self.size_m))

    def contains(self, points_world: Array) -> Mask:
        """Which of the points (N, 3) are inside."""
        points = (points_world - self.T_world_box[:3, 3]) @ self.T_world_box[:3, :3]
        return np.asarray((np.abs(points) <= 0.5 * self.size_m).all(axis=1))


def upright_axes(up_world: Array) -> Array:
    """A rotation (3, 3) R_world_upright whose third axis is a unit vector (3,)."""
    first = np.eye(3)[np.abs(up_world).argmin()]
    first = first - (first @ up_world) * up_world
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(up_world, first), up_world], axis=1)


def supported(points: Array, neighbours: int, reach_m: float) -> Mask:
    """Which of the points (N, 3) of one thing have so many others near them.

    Near is within ``reach_m`` and, where points are sparse, three times the median distance of the
    farthest of a point's ``neighbours``. All, where nobody has. A lone point is an error of depth
    or of a mask; a quantile would also take away faces that are seen at a glancing angle.
    """
    if neighbours < 1 or len(points) <= neighbours:
        return np.ones(len(points), bool)
    farthest_m = KDTree(points).query(points, neighbours + 1)[0][:, -1]
    near = np.asarray(farthest_m <= max(reach_m, 3 * float(np.median(farthest_m))))
    return near if near.any() else np.ones(len(points), bool)


def box_around(points_world: Array, up_world: Array) -> OrientedBox:
    """The upright box of least ground area around points (N, 3), N >= 1."""
    R_world_upright = upright_axes(up_world)
    points = points_world @ R_world_upright
    low, high = points[:, 2].min(), points[:, 2].max()
    angle_deg = cv2.minAreaRect(points[:, :2].astype(np.float32))[2]
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    flat = points[:, :2] @ turn
    middle = turn @ (0.5 * (flat.min(axis=0) + flat.max(axis=0)))
    size_m = np.array([*np.ptp(flat, axis=0), high - low])
    T = np.eye(4)
    T[:3, :3] = R_world_upright @ np.block([[turn, np.zeros((2, 1))], [0, 0, 1]])
    T[:3, 3] = R_world_upright @ [*middle, 0.5 * (low + high)]
    return OrientedBox(T, np.maximum(size_m, MIN_SIZE_M))


def without_noise(points_world: Array, noise_world: Array, up_world: Array, share: float) -> Array:
    """The points (N, 3), those moved in that noise may have carried out of the thing's box.

    ``noise_world`` (N, 3) is what a sigma of its depth moves each by. Each side of the box moves in
    by the median of this in its direction, but not beyond that share of the points.
    """
    T_world_box = box_around(points_world, up_world).T_world_box
    axes = T_world_box[:3, :3]
    local = (points_world - T_world_box[:3, 3]) @ axes
    reach = np.median(np.abs(noise_world @ axes), axis=0)
    low, high = np.quantile(local, [share, 1 - share], axis=0)
    low, high = np.minimum(low, local.min(0) + reach), np.maximum(high, local.max(0) - reach)
    return np.asarray(np.clip(local, low, high) @ axes.T + T_world_box[:3, 3])


def box_iou(a: OrientedBox, b: OrientedBox) -> float:
    """Volume of the intersection over that of the union, by a grid of 4096 points in each box."""
    shares = [q.contains(_filled(p)).mean() * p.volume_m3 for p, q in ((a, b), (b, a))]
    both = 0.5 * sum(shares)
    return float(both / (a.volume_m3 + b.volume_m3 - both))


def _filled(box: OrientedBox) -> Array:
    """A regular grid of points (4096, 3) in a box."""
    return ((_GRID - 0.5) * box.size_m) @ box.T_world_box[:3, :3].T + box.T_world_box[:3, 3]
