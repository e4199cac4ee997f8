"""Removing observations from map and graph together: under a mask, of landmarks, of a loop.

Masks of a keyframe may come seconds after it. By then its landmarks may have been fused into
others, culled, or marginalised out of the graph, the keyframe may have been culled, its segment
joined to another, a loop closed. So everything is looked up by the ids as they are now. The graph
is changed first and the map follows, but for landmarks that move: they leave the map first.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from bmask_slam.back_end.factor_selection import read_back
from bmask_slam.graph.arrays import Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import LOOP, GraphUpdate, RelativePoseName
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.masked_keypoints import keypoints_under
from bmask_slam.world.world_map import WorldMap


def _no_ids() -> Ints:
    return np.zeros(0, np.int64)


@dataclass(frozen=True)
class PruneReport:
    """The result of pruning in map and graph.

    Attributes:
        landmark_ids: (N,) sorted, removed from map and graph with all their observations.
        observations: (N, 2) keyframe and landmark id, removed without their landmark.
        loops: names of removed relative poses.
        refused: why nothing was done; "" if done.
        dropped_landmarks: (N,) out of the graph as well, left underconstrained there; they are
            still in the map and may enter again.
        anchored_keyframes: (N,) left underconstrained, and anchored loosely where they are.
    """

    landmark_ids: Ints = field(default_factory=_no_ids)
    observations: Ints = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    loops: tuple[RelativePoseName, ...] = ()
    refused: str = ""
    dropped_landmarks: Ints = field(default_factory=_no_ids)
    anchored_keyframes: Ints = field(default_factory=_no_ids)

    def counts(self, reason: str) -> dict[str, int]:
        """How much left the graph for a reason, and in its wake, as `EventLog.count` takes it."""
        return {
            f"landmarks pruned: {reason}": len(self.landmark_ids),
            f"observations pruned: {reason}": len(self.observations),
            f"loops pruned: {reason}": len(self.loops),
            "landmarks dropped": len(self.dropped_landmarks),
            "keyframes anchored": len(self.anchored_keyframes),
        }

    def __str__(self) -> str:
        """One line for the log."""
        if self.refused:
            return f"nothing removed: {self.refused}"
        counts = {
            "landmarks": len(self.landmark_ids),
            "observations": len(self.observations),
            "loops": len(self.loops),
        }
        removed = ", ".join(f"{n} {what}" for what, n in counts.items() if n) or "nothing"
        line = f"{removed} removed"
        if len(self.dropped_landmarks):
            line += f"; {len(self.dropped_landmarks)} landmarks underconstrained in the graph"
        if len(self.anchored_keyframes):
            line += f"; keyframes anchored: {self.anchored_keyframes.tolist()}"
        return line


@dataclass(frozen=True)
class MapPruner:
    """Takes observations out of one map and its graph, and leaves both consistent.

    Masks are narrowed by ``border_px`` all round, since segmentation errs there; a negative number
    widens them.
    """

    world: WorldMap
    smoother: Smoother
    camera: Camera
    border_px: int = 2

    def prune_mask(self, keyframe_id: int, mask: Mask) -> PruneReport:
        """Remove what a keyframe observes under a mask (H, W) of its image, as recorded.

        The keypoints observe nothing from now on and make no landmark. A culled keyframe has no
        observations to remove.
        """
        expected = (self.camera.height, self.camera.width)
        if mask.shape != expected or mask.dtype != bool:
            given = f"{mask.dtype} of shape {mask.shape}"
            return PruneReport(refused=f"the mask is {given}, the image needs bool {expected}")
        if keyframe_id in self.world.culled:
            return PruneReport()
        keyframe = self.world.keyframes.get(keyframe_id)
        if keyframe is None:
            return PruneReport(refused=f"keyframe {keyframe_id} is not in the map")
        keypoints = keypoints_under(mask, keyframe.features.image_pixels, self.border_px)
        return self._prune_observations(keyframe, keypoints)

    def prune_landmarks(self, ids: Ints) -> PruneReport:
        """Remove landmarks (N,), or those into which they were fused, from the map alone.

        Ids that are not in the map are skipped. The graph is left to its next update: one for them
        alone would take as long as that for a keyframe.
        """
        landmarks = self.world.landmarks
        known = ids[(ids >= 0) & (ids < len(landmarks))]
        current = np.unique(landmarks.current(known))
        removed = current[landmarks.in_map[current]]
        self.world.mask_landmarks(removed)
        return PruneReport(removed)

    def prune_loop(self, keyframe_a: int, keyframe_b: int) -> PruneReport:
        """Remove a loop: its relative poses, and the fusions of landmarks that it caused.

        A landmark counts as fused by the loop if keyframes around both ends see it (covisible with
        an end and nearer to it in time), but none in between for half of the way or more; the views
        of the newer side become a landmark of their own.
        """
        ends = sorted((keyframe_a, keyframe_b))
        missing = [k for k in ends if k not in self.world.keyframes]
        if missing:
            return PruneReport(refused=f"keyframe {missing[0]} is not in the map")
        old_side, new_side = (self._side(end, ends) for end in ends)
        fused = np.intersect1d(self._observed_from(old_side), self._observed_from(new_side))
        fused = fused[self._longest_pause(fused) >= np.ptp(self._position(ends)) / 2]
        pairs = [
            np.stack([np.full(len(ids), k.id), ids], axis=1)
            for k in new_side
            if len(ids := np.intersect1d(self.world.observed(k)[1], fused))
        ]
        known = self.smoother.relative_poses(LOOP)
        loops = tuple(loop.name for loop in known if sorted(loop.keyframe_ids) == ends)
        update = GraphUpdate(
            remove_observations=np.concatenate([np.zeros((0, 2), np.int64), *pairs]),
            remove_relative_poses=loops,
        )
        estimate = self.smoother.update(update)
        self.world.split(fused, new_side, self.camera)
        read_back(self.world, estimate)
        report = _report(update, estimate)
        return replace(report, loops=loops)

    def _side(self, end: int, ends: list[int]) -> list[Keyframe]:
        """Keyframes covisible with one end of a loop and nearer to it than to the other."""
        (other,) = (k for k in ends if k != end)
        _, observed_ids = self.world.observed(self.world.keyframes[end])
        near = [k for _, k in self.world.covisible(observed_ids, 1)]
        return [k for k in near if abs(k.id - end) < abs(k.id - other)]

    def _position(self, keyframe_ids: list[int]) -> Ints:
        """Positions (N,) of keyframes in the order of the map."""
        return np.searchsorted(sorted(self.world.keyframes), keyframe_ids)

    def _longest_pause(self, ids: Ints) -> Ints:
        """Largest number (N,) of keyframes between two views of each landmark; ids are sorted."""
        views = [
            np.stack([np.searchsorted(ids, common), np.full(len(common), place)])
            for place, k in enumerate(sorted(self.world.keyframes))
            if len(common := np.intersect1d(self.world.observed(self.world.keyframes[k])[1], ids))
        ]
        row, place = np.concatenate([np.zeros((2, 0), np.int64), *views], axis=1)
        order = np.lexsort((place, row))
        row, step = row[order], np.diff(place[order], prepend=0)
        first = np.diff(row, prepend=-1) > 0
        longest = np.zeros(len(ids), np.int64)
        np.maximum.at(longest, row[~first], step[~first])
        return longest

    def _observed_from(self, keyframes: list[Keyframe]) -> Ints:
        ids = [self.world.observed(keyframe)[1] for keyframe in keyframes]
        return np.unique(np.concatenate([np.zeros(0, np.int64), *ids]))

    def _prune_observations(self, keyframe: Keyframe, keypoints: Ints) -> PruneReport:
        """Remove the observations of keypoints (N,), and landmarks without other observations."""
        ids = keyframe.landmark_ids[keypoints]
        existing = (ids >= 0) & self.world.landmarks.in_map[ids]
        alone = existing & (self.world.landmarks.observations[ids] <= 1)
        shared = ids[existing & ~alone]
        pairs = np.stack([np.full(len(shared), keyframe.id), shared], axis=1)
        report = self._remove(np.unique(ids[alone]), pairs)
        self.world.mask(keyframe, keypoints)
        return report

    def _remove(self, ids: Ints, pairs: Ints) -> PruneReport:
        """Remove landmarks from graph and map, and single observations (N, 2) from the graph."""
        if not len(ids) and not len(pairs):
            return PruneReport()
        update = GraphUpdate(remove_landmarks=ids, remove_observations=pairs)
        estimate = self.smoother.update(update)
        self.world.mask_landmarks(ids)
        read_back(self.world, estimate)
        return _report(update, estimate)


def _report(update: GraphUpdate, estimate: GraphEstimate) -> PruneReport:
    return PruneReport(
        landmark_ids=update.remove_landmarks,
        observations=update.remove_observations,
        dropped_landmarks=estimate.dropped_landmarks,
        anchored_keyframes=estimate.anchored_keyframes,
    )
