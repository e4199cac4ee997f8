"""The floor plan: cells with obstacles and their labels, free floor, and the camera's path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Image, Ints
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.pictures import EMPTY, WALL, palette, with_legend
from bmask_slam.mapping.products.surface_regions import STRUCTURE
from bmask_slam.semantics.beliefs.surface_geometry import FLOORS

FLOOR_COLOUR = (235, 230, 215)
HEIGHTS_M = (0.1, 1.9)
"""Heights above the floor between which points are obstacles; walls may be higher."""
CEILING = "ceiling"
NAMED_M2 = 0.05
FONT, NAME_SIZE = cv2.FONT_HERSHEY_SIMPLEX, 0.5
GAP_M = 0.3
UPRIGHT_COSINE = 0.95
BIN_M = 0.04
GUESS_DEG, CANDIDATES = 45.0, 400


def up_direction(
    normals: NDArray[np.floating], first_guess: Array, guess_deg: float = GUESS_DEG
) -> Array:
    """The world's upward unit vector (3,): the most frequent normal (N, 3) near ``first_guess``.

    Floors and table tops have this normal, ceilings its opposite. The guess, e.g. the cameras' mean
    -y axis, may be ``guess_deg`` off. The search starts with the one of CANDIDATES normals that has
    most others within 8 degrees, and refines it by means over cones that narrow to 4 degrees.
    """
    up = first_guess / np.linalg.norm(first_guess)
    cosine = normals @ up
    possible = (np.sign(cosine)[:, None] * normals)[np.abs(cosine) > np.cos(np.deg2rad(guess_deg))]
    if len(possible) < 100:
        return np.asarray(up, float)
    candidates = possible[:: max(len(possible) // CANDIDATES, 1)]
    others = possible[:: max(len(possible) // (20 * CANDIDATES), 1)]
    votes = (candidates @ others.T > np.cos(np.deg2rad(8))).sum(axis=1)
    up = candidates[votes.argmax()]
    for degrees in (12, 8, 6, 4):
        near = possible[possible @ up > np.cos(np.deg2rad(degrees))]
        mean = near.sum(axis=0)
        up = mean / np.linalg.norm(mean)
    return np.asarray(up, float)


def fit_floor(points: Array, up: Array, floor_m: float) -> tuple[Array, float]:
    """Up (3,) and the floor's height, from a plane through the points (N, 3) near the floor.

    The mean of the normals is not exact enough: over some metres it is centimetres off.
    """
    for _ in range(4):
        near = points[np.abs(points @ up - floor_m) < 1.5 * BIN_M]
        if len(near) < 100:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        up = normal * np.sign(normal @ up)
        floor_m = float(middle @ up)
    return up, floor_m


def floor_height(heights_m: Array, share: float = 0.15) -> float:
    """Height of the floor: the lowest strong peak of the heights (N,) of upward-facing points."""
    if not len(heights_m):
        return 0.0
    low = float(np.quantile(heights_m, 0.002))
    bins = np.floor((heights_m - low) / BIN_M).astype(int)
    count = np.bincount(np.maximum(bins, 0))
    peak = int(np.flatnonzero(count >= share * count.max())[0])
    near = np.abs(heights_m - (low + (peak + 0.5) * BIN_M)) < 1.5 * BIN_M
    return float(np.median(heights_m[near]))


@dataclass(frozen=True, eq=False)
class PlanFrame:
    """Axes of the plan in the world.

    Attributes:
        axes: (3, 3), rows right, forward and up.
        floor_m: the floor's height along up.
        cell_m: edge of a cell.
    """

    axes: Array
    floor_m: float
    cell_m: float


def plan_frame(points: Array, normals: Array, first_guess: Array, cell_m: float) -> PlanFrame:
    """The plan's frame by points (N, 3) with normals: up from the floor, right along the walls."""
    up = up_direction(normals, first_guess)
    facing = points[normals @ up > UPRIGHT_COSINE].astype(float)
    seen = facing if len(facing) else points.astype(float)  # of walls alone the lowest part
    up, floor_m = fit_floor(facing, up, floor_height(seen @ up))
    return PlanFrame(axes_along_walls(up, normals), floor_m, cell_m)


def axes_along_walls(up: Array, normals: Array) -> Array:
    """Axes (3, 3), rows right, forward and ``up`` (3,), of walls with normals among (N, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(up))]
    right = np.cross(helper, up)
    right /= np.linalg.norm(right)
    forward = np.cross(up, right)
    walls = normals[np.abs(normals @ up) < 0.1]
    angle = np.arctan2(walls @ forward, walls @ right)
    turn = np.angle(np.exp(4j * angle).sum()) / 4 if len(walls) else 0.0
    right, forward = (
        np.cos(turn) * right + np.sin(turn) * forward,
        np.cos(turn) * forward - np.sin(turn) * right,
    )
    return np.stack([right, forward, up])


class FloorPlan:
    """A grid of cells that counts the points of a cloud, block by block.

    Where the labels ``names`` tell walls, floor and ceiling, the walls of the plan are theirs.
    """

    def __init__(self, frame: PlanFrame, names: Sequence[str]) -> None:
        self.frame = frame
        self._names = tuple(names)
        self._structure = np.isin(self._names, STRUCTURE)
        self._flat = np.isin(self._names, (*FLOORS, CEILING))
        self._standing = np.zeros((0, 4), np.int64)  # column, row, label, points
        self._floor = np.zeros((0, 2), np.int64)

    def add(self, cloud: Cloud) -> None:
        """Add a block of the cloud."""
        placed = cloud.points.astype(float) @ self.frame.axes.T
        height_m = placed[:, 2] - self.frame.floor_m
        cells = np.floor(placed[:, :2] / self.frame.cell_m).astype(np.int64)
        below = (height_m < HEIGHTS_M[1]) | self._structure[cloud.labels]
        standing = (height_m > HEIGHTS_M[0]) & below & ~self._flat[cloud.labels]
        rows = np.column_stack([cells[standing], cloud.labels[standing].astype(np.int64)])
        found, count = np.unique(rows, axis=0, return_counts=True)
        self._standing = np.concatenate([self._standing, np.column_stack([found, count])])
        walked = cells[np.abs(height_m) < HEIGHTS_M[0] / 2]
        self._floor = np.concatenate([self._floor, np.unique(walked, axis=0)])

    def grid(self, path_world: Array) -> tuple[NDArray[np.int16], Array]:
        """The cells (H, W), forward is up: label of an obstacle, -1 for floor, -2 for unobserved.

        The second result is the path (N, 3) in columns and rows (N, 2), which lies in the grid.
        """
        path = (path_world @ self.frame.axes.T)[:, :2] / self.frame.cell_m
        cells = np.concatenate([self._standing[:, :2], self._floor, np.floor(path).astype(int)])
        low, high = cells.min(axis=0), cells.max(axis=0)
        width, height = high - low + 1
        grid = np.full((height, width), -2, np.int16)
        grid[high[1] - self._floor[:, 1], self._floor[:, 0] - low[0]] = -1
        column, row, label, points = self._standing.T
        places, which = np.unique(
            (high[1] - row) * width + column - low[0], return_inverse=True
        )  # of the cells with obstacles: a table of all cells by all classes takes gigabytes
        votes = np.zeros((len(places), len(self._names)), np.int64)
        np.add.at(votes, (which, label), points)
        grid.reshape(-1)[places] = _labels(votes)
        if WALL in self._names:
            self._close_walls(grid)
        return grid, np.column_stack([path[:, 0] - low[0], high[1] + 1 - path[:, 1]])

    def _close_walls(self, grid: NDArray[np.int16]) -> None:
        """Fill gaps of up to GAP_M in the walls, which run along the axes, of cells (H, W)."""
        wall = self._names.index(WALL)
        length = round(GAP_M / self.frame.cell_m) + 1
        mask = np.pad((grid == wall).astype(np.uint8), length)  # nothing is beyond the border
        inside = (slice(length, -length),) * 2
        for size in ((1, length), (length, 1)):
            kernel = np.ones(size, np.uint8)
            grown = cv2.dilate(mask, kernel, anchor=(0, 0))  # MORPH_CLOSE shifts by even lengths
            closed = cv2.erode(grown, kernel, anchor=(size[1] - 1, size[0] - 1))
            grid[(closed[inside] > 0) & (grid < 0)] = wall

    def picture(self, path_world: Array, begins: Ints | None = None) -> Image:
        """The plan (H, W, 3), red first, with scale bar, legend and the camera's path (N, 3).

        ``begins`` are rows of the path that no line leads to.
        """
        grid, path = self.grid(path_world)
        scale = max(1, round(900 / max(grid.shape)))
        names = self._names
        colours = np.vstack([[[EMPTY] * 3, FLOOR_COLOUR], palette(names)]).astype(np.uint8)
        image = np.kron(colours[grid + 2], np.ones((scale, scale, 1), np.uint8))
        lines = np.split(np.rint(path * scale).astype(np.int32), [] if begins is None else begins)
        cv2.polylines(image, lines, False, (220, 30, 30), 2, cv2.LINE_AA)
        _write_names(image, grid, names, (scale, self.frame.cell_m))
        margin, white = 40, (EMPTY,) * 3
        image = cv2.copyMakeBorder(
            image, margin, 2 * margin, margin, margin, cv2.BORDER_CONSTANT, value=white
        )
        _scale_bar(image, scale / self.frame.cell_m, margin)
        present = [label for label in range(len(names)) if (grid == label).any()]
        return with_legend(image, names, present)


def _write_names(
    image: Image, grid: NDArray[np.int16], names: Sequence[str], sizes: tuple[int, float]
) -> None:
    """Write its class on each region of cells (H, W) that is NAMED_M2 large, but for structure.

    ``sizes``: pixels of the image and metres a cell.
    """
    scale, cell_m = sizes
    unnamed = (*STRUCTURE, *FLOORS, CEILING)
    for label in (k for k in range(1, len(names)) if names[k] not in unnamed):
        count, parts, stats, _ = cv2.connectedComponentsWithStats((grid == label).astype(np.uint8))
        large = stats[:, cv2.CC_STAT_AREA] * cell_m**2 >= NAMED_M2
        (width, height), _ = cv2.getTextSize(names[label], FONT, NAME_SIZE, 1)
        for part in (k for k in range(1, count) if large[k]):
            inside = np.pad((parts == part).astype(np.uint8), 1)
            far = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
            row, column = np.unravel_index(int(far.argmax()), far.shape)
            x, y = (float(column) - 0.5) * scale, (float(row) - 0.5) * scale
            corner = int(x - width / 2), int(y + height / 2)
            for grey, stroke in ((EMPTY, 4), (0, 1)):
                cv2.putText(
                    image, names[label], corner, FONT, NAME_SIZE, (grey,) * 3, stroke, cv2.LINE_AA
                )


def _labels(votes: Ints) -> Ints:
    """The class (N,) of cells by votes (N, C): an object with a fifth of them beats background."""
    class_votes = votes[:, 1:]
    if class_votes.shape[1] == 0:
        return np.zeros(len(votes), np.int64)
    enough = class_votes.max(axis=1) > 0.2 * votes.sum(axis=1)
    return np.where(enough, class_votes.argmax(axis=1) + 1, 0)


def _scale_bar(image: Image, px_per_m: float, margin: int) -> None:
    """Draw a bar of one metre at the lower left."""
    x, y, length = margin, image.shape[0] - margin // 2, round(px_per_m)
    cv2.rectangle(image, (x, y - 6), (x + length, y), (0, 0, 0), -1)
    cv2.putText(
        image, "1 m", (x + length + 8, y + 1), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1,
        cv2.LINE_AA,
    )  # fmt: skip
