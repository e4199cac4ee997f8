"""The local map: landmarks around what a frame shows, against which it is tracked."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Ints
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class LocalMapConfig:
    """The local map holds the landmarks of up to ``keyframes`` keyframes.

    They are those that share most landmarks with a frame, at least ``min_shared`` each.
    """

    keyframes: int = 15
    min_shared: int = 15


def local_landmarks(world: WorldMap, observed_ids: Ints, config: LocalMapConfig) -> Ints:
    """Ids of the landmarks of the keyframes that share most with the observed ones, sorted."""
    strong = world.covisible(observed_ids, config.min_shared)[: config.keyframes]
    if not strong:
        return np.unique(observed_ids)
    chosen = np.zeros(len(world.landmarks) + 1, bool)  # the last entry is for id -1
    for ids in (*(keyframe.landmark_ids for _, keyframe in strong), observed_ids):
        chosen[ids] = True
    return np.flatnonzero(chosen[:-1] & world.landmarks.in_map)
