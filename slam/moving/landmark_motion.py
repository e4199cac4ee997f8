"""Which landmarks move, by the depth of frames and by the masks of keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bmask_slam.graph.arrays import Arrays, Ints
from bmask_slam.moving.free_space_check import DepthView, FreeSpaceCheck, PointMotion
from bmask_slam.moving.keyframe_masks import KeyframeMasks
from bmask_slam.semantics.beliefs.movability import (
    MovabilityConfig,
    MovabilityFilter,
    MovabilityPriors,
)
from bmask_slam.semantics.tracks.instance_track import Sighting
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.map_editor import MapEditor


class LandmarkMotion:
    """P(moving) of landmarks; those that move are taken out of the map.

    Attributes:
        movability: the binary Bayes filter of each landmark, by id.
    """

    def __init__(
        self,
        check: FreeSpaceCheck,
        priors: MovabilityPriors,
        config: MovabilityConfig,
        map_editor: MapEditor,
    ) -> None:
        self.movability = MovabilityFilter(priors.unknown, config)
        self._check, self._priors, self._config = check, priors, config
        self._map = map_editor

    def state(self) -> Arrays:
        """The filters of all landmarks, as named arrays."""
        return self.movability.state()

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self.movability.restore(state)

    def observe_frame(self, tracked: Tracked, view: DepthView | None) -> Ints:
        """Update landmarks in view by a frame's depth; returns the ids of those that move.

        What tracking found to move is evidence, too.
        """
        ids, power = tracked.visible_ids, self._config.frame_power
        self.movability.update(tracked.moving_ids, np.ones(len(tracked.moving_ids), bool), power)
        if view is None or not len(ids):
            return ids[self.movability.moving(ids)]
        landmarks = self._map.world.landmarks
        motions = self._check.judge(landmarks.points_world[ids], view, tracked.T_world_camera)
        removed = motions == PointMotion.MOVING
        tracked_now = np.zeros(len(landmarks), bool)
        tracked_now[tracked.landmark_ids] = True
        found = tracked_now[ids]
        removed &= ~found
        judged = found | removed
        self.movability.update(ids[judged], removed[judged], power)
        return ids[self.movability.moving(ids)]

    def observe_masks(
        self,
        masks: KeyframeMasks,
        sightings: Sequence[Sighting | None],
        class_is_no_evidence: Sequence[bool],
    ) -> None:
        """Set the priors of landmarks by the classes of their instances, and update them by views.

        An instance's class is no evidence, one of (K,), where it has stood for long.
        """
        ids, first = np.unique(masks.landmark_ids, return_index=True)
        priors = masks.label_distributions[first] @ self._priors.of(masks.names)
        instances = masks.instances[first]
        stands = np.array([*class_is_no_evidence, False])
        evidence = np.array([0.0 if s is None else s.evidence for s in sightings] + [0.0])
        priors[stands[instances]] = np.minimum(priors[stands[instances]], self._priors.unknown)
        self.movability.set_priors(ids, np.clip(priors, 0.01, 0.99))
        judged = evidence[instances] != 0
        self.movability.update(ids[judged], evidence[instances[judged]] > 0)

    def remove_moving(self, ids: Ints) -> None:
        """Take the landmarks among these (N,) that move out of map and graph."""
        ids = self._map.world.landmarks.remaining(ids)
        ids = ids[self.movability.moving(ids)]
        if len(ids):
            self._map.prune_landmarks(ids)
            self.movability.drop(ids)

    def follow_map(self) -> None:
        """Move the filters of fused landmarks to their successors; drop those of removed ones."""
        landmarks = self._map.world.landmarks
        removed = self.movability.known(without=landmarks.in_map)
        current = landmarks.current(removed)
        kept = landmarks.in_map[current]
        self.movability.move(removed[kept], current[kept])
        self.movability.drop(removed[~kept])
