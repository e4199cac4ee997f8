"""Stuff in the dense map: what the pixels of a keyframe are where no instance is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.mapping.compiled import compiled
from bmask_slam.semantics.beliefs.surface_geometry import Ground, log_likelihoods, with_evidence
from bmask_slam.semantics.beliefs.surface_store import MIN_PROBABILITY, log_view, pooled
from bmask_slam.semantics.instances.surfaces import SurfaceClasses

SURE = (0.5, 0.75)
"""A class's pixels make up to three regions a keyframe, by the probability that it has there."""
STRUCTURE = (
    *("wall", "window", "door", "blinds", "curtain", "shower curtain", "picture", "whiteboard"),
    *("mirror", "other structure"),
)
"""Classes of what bounds a room."""


@dataclass(frozen=True, eq=False)
class Regions:
    """Regions of a keyframe's pixels.

    Attributes:
        numbers: (H, W) uint16, the region of each pixel, from 1; 0 for none.
        log_p: (R, C) float32, the logarithm of the mean class distribution of each region.
        names: the C classes.
    """

    numbers: NDArray[np.uint16]
    log_p: Floats
    names: tuple[str, ...] = ()


def find_regions(seen: SurfaceClasses | None, free: Mask) -> Regions:
    """The regions among pixels (H, W) that are ``free`` of instances."""
    numbers = np.zeros(free.shape, np.uint16)
    if seen is None:
        return Regions(numbers, np.zeros((0, 0), np.float32))
    p, grades = np.ascontiguousarray(seen.pixels()), len(SURE) + 1
    keys = np.empty(free.shape, np.int64)
    sums, counts = np.zeros((p.shape[2] * grades, p.shape[2])), np.zeros(p.shape[2] * grades)
    sum_alike(p, free, np.array(SURE, np.float32), (keys, sums, counts))
    used = counts > 0
    numbers[free] = np.cumsum(used)[keys[free]]
    mean = sums[used] / counts[used, None]
    return Regions(numbers, log_view(mean.astype(np.float32)), seen.labels.names[1:])


@compiled
def sum_alike(p: Floats, free: Mask, sure: Floats, made: tuple[Ints, Array, Array]) -> None:
    """Add up the class distributions p (H, W, C) of free pixels of one class and grade.

    A grade is how many of the probabilities ``sure`` (S,) that of the likeliest class exceeds.
    Filled in: the key (H, W) of each free pixel, class (S + 1) + grade, and the sum (K, C) and
    number (K,) of the pixels of each key.
    """
    keys, sums, counts = made
    height, width, classes = p.shape
    for v in range(height):
        for u in range(width):
            if not free[v, u]:
                continue
            best = 0
            for c in range(1, classes):
                if p[v, u, c] > p[v, u, best]:
                    best = c
            key = best * (len(sure) + 1)
            for limit in sure:
                key += p[v, u, best] > limit
            keys[v, u] = key
            counts[key] += 1
            for c in range(classes):
                sums[key, c] += p[v, u, c]


@dataclass(frozen=True, eq=False)
class StuffFusion:
    """How the stuff of keyframes is fused in a cloud.

    Attributes:
        names: the cloud's labels: of things, the first is the background, and behind them of stuff;
            what has one name in both is one class.
        stuff: the S classes of stuff.
        columns: (S,) where they are among the names.
        ground: where up and the floor are, if it is known.
    """

    names: tuple[str, ...]
    stuff: tuple[str, ...] = ()
    columns: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    ground: Ground | None = None

    @classmethod
    def of(
        cls, things: Sequence[str], stuff: Sequence[str], ground: Ground | None = None
    ) -> StuffFusion:
        """The fusion of these classes."""
        names = (*things, *(s for s in stuff if s not in things))
        columns = np.array([names.index(s) for s in stuff], np.int64)
        return cls(names, tuple(stuff), columns, ground)

    def labels(
        self,
        log_sums: Floats,
        views: Floats,
        points_world: NDArray[np.floating],
        normals_world: NDArray[np.floating],
    ) -> tuple[Ints, Floats]:
        """Class (N,) and probability (N,) from sums (N, S) of the logarithms of views (N,).

        With what height and slope of the points (N, 3) tell. The class is 0 where the likeliest one
        is not likely enough, or without a view.
        """
        p = pooled(log_sums.astype(float), views.astype(float))
        if self.ground is not None:
            heights_m = self.ground.heights_m(points_world.astype(float))
            cosines = normals_world.astype(float) @ self.ground.up_world
            p = with_evidence(p, log_likelihoods(self.stuff, heights_m, cosines))
        best = p.max(axis=1)
        known = (views > 0) & (best >= MIN_PROBABILITY)
        return np.where(known, self.columns[p.argmax(axis=1)], 0), best.astype(np.float32)
