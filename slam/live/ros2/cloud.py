"""The points of a live dense map: submaps that follow their keyframes, thinned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.geometry import transform

MAX_POINTS = 200_000
"""In a message; of more, every second, third, ... is left in."""
_BITS = 21
"""Of a voxel's number along one axis."""


@dataclass(frozen=True, eq=False)
class _Points:
    """Points (N, 3) in the frame of their keyframe, and colours (N, 3)."""

    points: Floats
    colours: Bytes


class LiveCloud:
    """Keeps each submap's points; for one thread but for ``add``."""

    def __init__(self, T_map_world: Array, voxel_m: float) -> None:
        self._T_map_world, self._voxel_m = T_map_world, voxel_m
        self._submaps: dict[int, _Points] = {}

    def add(self, number: int, points: Floats, colours: Bytes) -> None:
        """A submap's points (N, 3) in its keyframe's frame, and colours; from any thread."""
        self._submaps[number] = _Points(points, colours)

    def cloud(self, poses: dict[int, Array]) -> tuple[Array, Bytes] | None:
        """Points (N, 3) in the map's frame, one a voxel, and colours (N, 3); None while empty.

        ``poses``: T_world_camera (4, 4) of the keyframes in the map. The newest submap that has a
        voxel gives its point.
        """
        known = {n: s for n, s in self._submaps.copy().items() if n in poses and len(s.points)}
        if not known:
            return None
        newest = sorted(known, reverse=True)
        points = np.concatenate(
            [transform(self._T_map_world @ poses[n], known[n].points.astype(float)) for n in newest]
        )
        colours = np.concatenate([known[n].colours for n in newest])
        cells = np.floor(points / self._voxel_m).astype(np.int64) + (1 << (_BITS - 1))
        cells = np.clip(cells, 0, (1 << _BITS) - 1)
        codes = (cells[:, 0] << 2 * _BITS) | (cells[:, 1] << _BITS) | cells[:, 2]
        first = np.unique(codes, return_index=True)[1]
        chosen = first[:: len(first) // (MAX_POINTS + 1) + 1]
        return points[chosen], colours[chosen]
