"""The labelled points of a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Bytes, Floats, Mask


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of the map.

    Attributes:
        points, normals: (N, 3) float32 in the world, metres.
        colours: (N, 3) uint8 red first.
        sigmas_m: (N,) float32, standard deviation.
        labels: (N,) uint16, most probable class; 0 is the background.
        probabilities: (N,) float32 of that class.
        views: (N,) uint16, number of frames that saw the point, 0 in a hole that was closed.
    """

    points: Floats
    normals: Floats
    colours: Bytes
    sigmas_m: Floats
    labels: NDArray[np.uint16]
    probabilities: Floats
    views: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.points)

    def select(self, rows: Mask | slice) -> Cloud:
        """Some of the points."""
        return Cloud(*(getattr(self, f.name)[rows] for f in fields(self)))

    @staticmethod
    def concatenate(clouds: Sequence[Cloud]) -> Cloud:
        """The points of several clouds."""
        return Cloud(*(np.concatenate([getattr(c, f.name) for c in clouds]) for f in fields(Cloud)))
