"""Gravity-aligned boxes in space: fitted to points, their corners, their overlap."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from bmask_slam.graph.arrays import Array, Ints, Mask

MIN_SIZE_M = 0.01
_SIGNS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
EDGES = np.array([(a, b) for a in range(8) for b in range(a) if (a ^ b).bit_count() == 1])
"""(12, 2) pairs of corners that an edge joins."""
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
        """The corners (8, 3); EDGES says which pairs an edge joins."""
        return self.in_world(0.5 * _SIGNS * self.size_m)

    @property
    def volume_m3(self) -> float:
        """The volume."""
        return float(np.prod(self.size_m))

    def in_world(self, points_box: Array) -> Array:
        """Points (N, 3) of the box's own frame in the world."""
        return np.asarray(points_box @ self.T_world_box[:3, :3].T + self.T_world_box[:3, 3])

    def contains(self, points_world: Array) -> Mask:
        """Which of the points (N, 3) are inside."""
        points = (points_world - self.T_world_box[:3, 3]) @ self.T_world_box[:3, :3]
        return np.asarray((np.abs(points) <= 0.5 * self.size_m).all(axis=1))


def gravity_axes(up_world: Array) -> Array:
    """The rotation R_world_gravity (3, 3) whose third axis is the unit vector (3,)."""
    first = np.eye(3)[np.abs(up_world).argmin()]
    first = first - (first @ up_world) * up_world
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(up_world, first), up_world], axis=1)


NEIGHBOURS = 24
"""So many nearest points are compared."""


def supported(points: Array, neighbours: int, reach_m: float) -> Mask:
    """Which of the points (N, 3) of one object have that many neighbours close by.

    Close is within ``reach_m`` or, where points are sparse, within three times the median distance
    to the farthest of a point's ``neighbours``. If no point qualifies, all do. An isolated point is
    an error of depth or of a mask; a quantile would also remove faces at a glancing angle.
    """
    if neighbours < 1 or len(points) <= neighbours:
        return np.ones(len(points), bool)
    farthest_m = KDTree(points).query(points, neighbours + 1)[0][:, -1]
    near = np.asarray(farthest_m <= max(reach_m, 3 * float(np.median(farthest_m))))
    return near if near.any() else np.ones(len(points), bool)


def seen_again(points: Array, views: Ints, reach_m: float) -> Mask:
    """Which of the points (N, 3) of one object other views than their own (N,) show as well.

    That is within ``reach_m`` or, where points are sparse, within three times the median distance
    to the nearest point of another view; that is looked for among the nearest NEIGHBOURS, unless
    most points have none there. All of fewer than three views do. What one mask alone shows is
    mostly what it shows beside the object.
    """
    count = min(NEIGHBOURS, len(points))
    if len(np.unique(views)) < 3:
        return np.ones(len(points), bool)
    distance_m, nearest = KDTree(points).query(points, count)
    other_m = np.where(views[nearest] != views[:, None], distance_m, np.inf).min(axis=1)
    if not np.isfinite(np.median(other_m)):  # views lie apart, or have very many points
        other_m = _to_other_views(points, views)
    return np.asarray(other_m <= max(reach_m, 3 * float(np.median(other_m))))


def _to_other_views(points: Array, views: Ints) -> Array:
    """Distance (N,) of each of the points (N, 3) to the nearest one of another view (N,)."""
    distance_m = np.empty(len(points))
    for view in np.unique(views).tolist():
        own = views == view
        distance_m[own] = KDTree(points[~own]).query(points[own])[0]
    return distance_m


def main_part(points: Array, cell_m: float, share: float) -> Mask:
    """Which of the points (N, 3) hang together with most, over cells of ``cell_m`` that touch.

    Parts with at least the ``share`` of the largest one's points are kept too. A mask with holes,
    such as a chair's, shows in some views what is behind, and that hangs apart.
    """
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64)
    occupied, where = np.unique(cells, axis=0, return_inverse=True)
    pairs = KDTree(occupied).query_pairs(1.8, output_type="ndarray")  # also over corners
    count = len(occupied)
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    parts = connected_components(graph, directed=False)[1][where.ravel()]
    sizes = np.bincount(parts)
    return np.asarray(sizes[parts] >= share * sizes.max())


def box_around(points_world: Array, up_world: Array) -> OrientedBox:
    """The gravity-aligned box of least ground area around points (N, 3), N >= 1."""
    R_world_gravity = gravity_axes(up_world)
    points = points_world @ R_world_gravity
    low, high = points[:, 2].min(), points[:, 2].max()
    angle_deg = cv2.minAreaRect(points[:, :2].astype(np.float32))[2]
    angle = np.deg2rad(angle_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    flat = points[:, :2] @ turn
    middle = turn @ (0.5 * (flat.min(axis=0) + flat.max(axis=0)))
    size_m = np.array([*np.ptp(flat, axis=0), high - low])
    T = np.eye(4)
    T[:3, :3] = R_world_gravity @ np.block([[turn, np.zeros((2, 1))], [0, 0, 1]])
    T[:3, 3] = R_world_gravity @ [*middle, 0.5 * (low + high)]
    return OrientedBox(T, np.maximum(size_m, MIN_SIZE_M))


def without_noise(points_world: Array, noise_world: Array, up_world: Array, share: float) -> Array:
    """The points (N, 3), clipped to their box after its sides were moved in by the noise.

    ``noise_world`` (N, 3) is the displacement of each point by one sigma of its depth. Each side
    moves in by the median displacement in its direction, but leaves at most ``share`` of the points
    outside.
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
    return box.in_world((_GRID - 0.5) * box.size_m)
