"""What height and slope tell about the class of a surface, where gravity and the floor are known.

The network sees colour alone: a green table top is a floor to it. In a map every point has a height
above the floor and, where it is dense, a normal. HHA (Gupta et al. 2014) gives both to the network;
its training images have no depth here, so both are evidence of their own, by what furniture is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.semantics.beliefs.surface_store import MIN_PROBABILITY
from bmask_slam.semantics.labels import LabelSet

FLOORS = ("floor", "floor mat")
ROOM_M = (-0.3, 3.0)
"""Heights above the floor of anything."""
HEIGHTS_M = {
    **dict.fromkeys(FLOORS, (-0.12, 0.12)),
    "ceiling": (1.9, 3.0),
    **dict.fromkeys(("table", "desk"), (0.1, 1.0)),
    **dict.fromkeys(("counter", "sink"), (0.5, 1.3)),
    **dict.fromkeys(("bed", "sofa", "chair", "bathtub", "night stand", "toilet"), (0.0, 1.3)),
    "pillow": (0.2, 1.3),
}
"""Heights of the surfaces of classes; of others any in the room."""
STRAY = 0.02
"""Likelihood of a class far from its heights, where it is 1: errors of the map, odd furniture."""
SOFT_M = 0.08
UP, UPRIGHT, DOWN, SLANTED = range(4)
_FLAT = (0.9, 0.03, 0.02, 0.05)
SLOPES = {
    **dict.fromkeys(FLOORS, _FLAT),
    "ceiling": (0.02, 0.03, 0.9, 0.05),
    **dict.fromkeys(("table", "desk", "counter"), (0.6, 0.25, 0.03, 0.12)),
    **dict.fromkeys(
        ("wall", "window", "door", "blinds", "curtain", "picture", "whiteboard", "mirror"),
        (0.05, 0.8, 0.03, 0.12),
    ),
}
"""Shares of a class's surface that face up, are upright, face down, are slanted."""
_ANY_SLOPE = (0.35, 0.4, 0.05, 0.2)
LEAST_POINTS = 20
BIN_M = 0.08
FAR_M = 20.0
"""Points so far above or below the others are errors, or on another storey."""
PEAK_SHARE = 0.25
MIN_CAMERA_HEIGHT_M = 0.6


@dataclass(frozen=True, eq=False)
class Ground:
    """Gravity in the world: ``up_world`` (3,), and the floor's height along it, NaN if unknown."""

    up_world: Array
    floor_m: float = float("nan")

    def heights_m(self, points_world: Array) -> Array:
        """Heights (N,) above the floor of points (N, 3)."""
        return np.asarray(points_world @ self.up_world - self.floor_m)


def find_ground(floor_world: Array, cameras_world: Array, up_world: Array) -> Ground | None:
    """The ground by points (N, 3) that look like floor: their lowest strong peak.

    None where there are too few, or where it is not well below the cameras (K, 3): what a low
    camera takes for the floor may be a table.
    """
    heights = floor_world @ up_world
    if len(heights):
        heights = heights[np.abs(heights - np.median(heights)) < FAR_M]
    if len(heights) < LEAST_POINTS or not len(cameras_world):
        return None
    low = float(np.quantile(heights, 0.01))
    bins = np.maximum(np.floor((heights - low) / BIN_M).astype(int), 0)
    count = np.bincount(bins)
    peak = int(np.flatnonzero(count >= PEAK_SHARE * count.max())[0])
    near = np.abs(heights - (low + (peak + 0.5) * BIN_M)) < 1.5 * BIN_M
    floor_m = float(np.median(heights[near]))
    if np.median(cameras_world @ up_world) - floor_m < MIN_CAMERA_HEIGHT_M:
        return None
    return Ground(up_world, floor_m)


def log_likelihoods(
    names: LabelSet | tuple[str, ...], heights_m: Array, cosines: Array | None = None
) -> Array:
    """log likelihoods (N, C), at most 0, of heights (N,) above the floor and of slopes.

    They rule out: within a class's heights, which end softly, they are 0, so that colour decides
    among the classes that are possible. ``cosines`` (N,) are those of the angles between normals
    and up. ``names`` are those of the classes; of a label set, those after the background.
    """
    classes = names.names[1:] if isinstance(names, LabelSet) else names
    low, high = np.array([HEIGHTS_M.get(name, ROOM_M) for name in classes]).T
    beyond_m = np.maximum(np.maximum(low - heights_m[:, None], heights_m[:, None] - high), 0)
    found = np.log(STRAY + (1 - STRAY) * np.exp(-0.5 * (beyond_m / SOFT_M) ** 2))
    if cosines is not None:
        shares = np.array([SLOPES.get(name, _ANY_SLOPE) for name in classes])
        found += np.log(np.minimum(shares / _ANY_SLOPE, 1)).T[slope(cosines)]
    return found


def slope(cosines: Array) -> Array:
    """UP, UPRIGHT, DOWN or SLANTED (N,) of the cosines (N,) between normals and up."""
    rules = [cosines > 0.85, cosines < -0.85, np.abs(cosines) < 0.35]
    return np.select(rules, [UP, DOWN, UPRIGHT], SLANTED)


def with_evidence(p: Array, log_likelihood: Array) -> Array:
    """Distributions (N, C) with further evidence (N, C), by Bayes' rule."""
    log_p = np.log(np.maximum(p, 1e-9)) + log_likelihood
    p = np.exp(log_p - log_p.max(axis=1, keepdims=True))
    return np.asarray(p / p.sum(axis=1, keepdims=True))


def by_height(
    names: LabelSet, p: Array, points_world: Array, cameras_world: Array, up_world: Array
) -> Array:
    """Distributions (N, C) of points (N, 3) with the evidence of their heights.

    The floor is found among the points that look like it. Without one nothing changes.
    """
    floors = [k - 1 for k in map(names.number, FLOORS) if k]
    likely = np.isin(p.argmax(axis=1), floors) & (p.max(axis=1) >= MIN_PROBABILITY)
    ground = find_ground(points_world[likely], cameras_world, up_world)
    if ground is None:
        return p
    return with_evidence(p, log_likelihoods(names, ground.heights_m(points_world)))
