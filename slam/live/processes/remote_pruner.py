"""Stands where an offline system has its ``MapPruner``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from bmask_slam.graph.arrays import Ints, Mask
from bmask_slam.live.messages import PruneLandmarks, PruneMask
from bmask_slam.semantics.instances.instances import PackedMask
from bmask_slam.world.world_map import WorldMap


@dataclass(frozen=True)
class RemotePruner:
    """Passes requests on through ``tell``; the map is changed when the answer comes."""

    world: WorldMap
    tell: Callable[[Any], None]
    border_px: int = 2

    def prune_landmarks(self, landmark_ids: Ints) -> None:
        """As ``MapPruner.prune_landmarks``. Tracking drops them at once."""
        self.world.landmarks.alive[landmark_ids] = False
        self.tell(PruneLandmarks(landmark_ids))

    def prune_mask(self, keyframe_id: int, mask: Mask) -> None:
        """As ``MapPruner.prune_mask``."""
        self.tell(PruneMask(keyframe_id, PackedMask.of(mask), self.border_px))
