"""Selects the observations that enter the factor graph, and reads its estimate back."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.back_end.factors import anchor, observations_of
from bmask_slam.features.brisk import spread_order
from bmask_slam.graph.arrays import Arrays, Ints, Mask
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, PosePrior, concatenate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.smoother.anchoring import firm_prior
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

MANY_BATCHES = 300
"""If more batches than these wait to be marginalised, all are at once. So many never gather in a
running session: it is a large map, opened again after its last optimisation put them all back."""


@dataclass(frozen=True)
class FactorSelectionConfig:
    """Limits on the size of the graph.

    A landmark enters when ``min_views`` keyframes see it, with all its observations so far. It is
    marginalised (`graph.marginals.landmark_marginalisation`) when none of the ``window_keyframes``
    that share most with the newest one sees it, and as soon as ``marginalise_batch`` wait for it,
    at most twice as many at once; it enters again when it is seen again. A map of up to
    ``full_keyframes`` keeps every landmark in the graph: that is more accurate, and fast enough. 0
    window keyframes: so does every map.
    """

    max_observations: int = 200
    min_views: int = 2
    bucket_px: int = 60
    full_keyframes: int = 100
    window_keyframes: int = 20
    window_min_shared: int = 15
    marginalise_batch: int = 100


class FactorSelector:
    """Turns changes of the map into updates of the graph and estimates back into the map.

    ``depth_factor`` is the camera's ``graph_depth_factor``, ``graph`` the graph's settings. An
    update looks only at keyframes of which something changed: its cost does not grow with the map.
    """

    def __init__(
        self,
        config: FactorSelectionConfig,
        depth_factor: float = 1.0,
        graph: SmootherConfig | None = None,
    ):
        self.config, self._graph = config, graph or SmootherConfig()
        self._depth_factor = depth_factor
        self._removed: list[Ints] = []
        self._removed_keyframes: list[int] = []
        self._forget()

    def remove_landmarks(self, ids: Ints) -> None:
        """Remove the factors of culled or fused landmarks with the next update."""
        self._removed.append(ids)

    def remove_keyframe(self, keyframe_id: int) -> None:
        """Remove the factors of a culled keyframe with the next update."""
        self._removed_keyframes.append(keyframe_id)

    @property
    def has_removals(self) -> bool:
        """Whether the next update will remove factors."""
        return bool(self._removed_keyframes) or any(map(len, self._removed))

    def state(self) -> Arrays:
        """Removals that the next update will carry out."""
        return {
            "removed": np.concatenate([np.zeros(0, np.int64), *self._removed]),
            "removed_keyframes": np.array(self._removed_keyframes, np.int64),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self._removed = [state["removed"]]
        self._removed_keyframes = state["removed_keyframes"].tolist()
        self._forget()

    def _forget(self) -> None:
        """Nothing is known of the map, so that the next update looks at all of it."""
        self._were_in_graph: Mask = np.zeros(0, bool)
        self._sent: Mask | None = None
        self._waiting: set[int] = set()
        """Keyframes that observe marginalised landmarks more often than the graph was told."""

    def keyframe_update(self, world: WorldMap, keyframe: Keyframe) -> GraphUpdate:
        """The update that adds one keyframe and its landmarks, with every other change.

        A keyframe with few landmarks in the graph, as behind a door or among people who were
        masked, is also held weakly to the one before. Without that the graph would refuse it, and
        then all that follow, since they share their landmarks with those that were refused.
        """
        keypoints, ids = world.observed(keyframe)
        inside = world.landmarks.in_graph[ids]
        new_ids = self._promoted(world, keyframe, keypoints[~inside], ids[~inside], inside.sum())
        world.landmarks.in_graph[new_ids] = True
        marginalised = self._outside_window(world, ids)
        world.landmarks.in_graph[marginalised] = False
        others = reversed(world.keyframes.values())
        before = (k for k in others if k.segment == keyframe.segment and k is not keyframe)
        last = next(before, None)
        few = int(inside.sum()) + len(new_ids) < self._graph.min_left_observations
        anchors = () if last is None or not few else (anchor(last, keyframe, self._graph),)
        return replace(
            self._changes(world),
            keyframe_ids=np.array([keyframe.id]),
            poses_world_camera=keyframe.T_world_camera[None],
            landmark_ids=new_ids,
            points_world=world.landmarks.points_world[new_ids],
            priors=(self._prior(keyframe),) if last is None else (),
            relative_poses=anchors,
            marginalise_landmarks=marginalised,
        )

    def map_update(self, world: WorldMap) -> GraphUpdate:
        """The update with changes of the map without a new keyframe: fusions, removals.

        Marginalised landmarks that were given observations enter the graph again.
        """
        again = self._marginalised_with_more(world)
        world.landmarks.in_graph[again] = True
        points = world.landmarks.points_world[again]
        return replace(self._changes(world), landmark_ids=again, points_world=points)

    def _marginalised_with_more(self, world: WorldMap) -> Ints:
        """Landmarks of the map that were sent, left the graph, and have unsent observations."""
        unsent = [np.zeros(0, np.int64)]
        for k in (self._waiting | world.changed) & world.keyframes.keys():
            keyframe = world.keyframes[k]
            unsent.append(keyframe.landmark_ids[keyframe.sent_ids != keyframe.landmark_ids])
        self._waiting.clear()
        ids = world.landmarks.remaining(np.unique(np.concatenate(unsent)))
        ids = ids[~world.landmarks.in_graph[ids]]
        return ids[was_sent(world, world.observing(ids))[ids]]

    def _changes(self, world: WorldMap) -> GraphUpdate:
        update = GraphUpdate(
            observations=self._unsent_observations(world),
            remove_landmarks=np.concatenate([np.zeros(0, np.int64), *self._removed]),
            remove_keyframes=np.array(self._removed_keyframes, np.int64),
        )
        self._removed, self._removed_keyframes = [], []
        return update

    def whole_update(self, world: WorldMap) -> GraphUpdate:
        """The update that fills an empty graph with the whole map, with one prior a segment."""
        self._removed, self._removed_keyframes = [], []
        keyframes = list(world.keyframes.values())
        landmarks = world.landmarks
        landmarks.in_graph[:] |= was_sent(world, keyframes)
        landmarks.in_graph[:] &= landmarks.in_map
        first = {k.segment: k for k in reversed(keyframes)}
        for keyframe in keyframes:
            keyframe.sent_ids[:] = -1
        world.changed.update(world.keyframes)
        ids = np.flatnonzero(landmarks.in_graph)
        return GraphUpdate(
            keyframe_ids=np.array([k.id for k in keyframes]),
            poses_world_camera=np.array([k.T_world_camera for k in keyframes]),
            landmark_ids=ids,
            points_world=landmarks.points_world[ids],
            observations=self._unsent_observations(world),
            priors=tuple(self._prior(first[s]) for s in sorted(first)),
        )

    def _prior(self, keyframe: Keyframe) -> PosePrior:
        """The first keyframe of a segment fixes the segment's frame."""
        return firm_prior(keyframe.id, keyframe.T_world_camera, self._graph)

    def _promoted(
        self, world: WorldMap, keyframe: Keyframe, keypoints: Ints, ids: Ints, already: int
    ) -> Ints:
        """Landmarks of the keyframe that enter the graph now, spread over the image."""
        views = world.landmarks.observations[ids]
        enough = views >= self.config.min_views
        keypoints, ids, views = keypoints[enough], ids[enough], views[enough]
        room = max(self.config.max_observations - int(already), 0)
        pixels = keyframe.features.image_pixels[keypoints] // self.config.bucket_px
        bucket = (pixels[:, 1] * 1000 + pixels[:, 0]).astype(np.int64)
        return np.sort(ids[spread_order(bucket, views.astype(float))[:room]])

    def _outside_window(self, world: WorldMap, observed_ids: Ints) -> Ints:
        """Landmarks in the graph that no keyframe of the active window observes, if enough.

        Those not observed for longest come first, two batches of them; all where very many wait, as
        in a large map that goes on after its last optimisation took all of them back.
        """
        count, landmarks = self.config.window_keyframes, world.landmarks
        if not count or len(world.keyframes) <= self.config.full_keyframes:
            return np.zeros(0, np.int64)
        near = [k for _, k in world.covisible(observed_ids, self.config.window_min_shared)[:count]]
        active = np.zeros(len(landmarks) + 1, bool)  # the last entry is for id -1
        active[observed_ids] = True
        for keyframe in near:
            active[keyframe.landmark_ids] = True
        waiting = np.flatnonzero(landmarks.in_graph & landmarks.in_map & ~active[:-1])
        batch = self.config.marginalise_batch
        if len(waiting) < batch:
            return waiting[:0]
        if len(waiting) > MANY_BATCHES * batch:
            return waiting
        oldest = np.argsort(landmarks.last_keyframe[waiting], kind="stable")[: 2 * batch]
        return np.sort(waiting[oldest])

    def _unsent_observations(self, world: WorldMap) -> Observations:
        """Every observation of a landmark in the graph that was not sent yet, in all keyframes.

        Observations that older keyframes gained by fusion are among them, and all of a landmark
        that enters.
        """
        in_graph = np.append(world.landmarks.in_graph, False)  # the last entry is for id -1
        sent = self._ever_sent(world)
        entered = in_graph.copy()
        entered[: len(self._were_in_graph)] &= ~self._were_in_graph
        self._were_in_graph = in_graph[:-1]
        concerned = {k.id for k in world.observing(np.flatnonzero(entered))} | world.changed
        world.changed.clear()
        parts = []
        for k in sorted(concerned & world.keyframes.keys()):
            keyframe = world.keyframes[k]
            ids = keyframe.landmark_ids
            unsent = keyframe.sent_ids != ids
            rows = np.flatnonzero(in_graph[ids] & unsent)
            if len(rows):
                parts.append(observations_of(keyframe, rows, ids[rows], self._depth_factor))
                keyframe.sent_ids[rows] = ids[rows]
                sent[ids[rows]] = True
            if (sent[ids] & unsent & ~in_graph[ids]).any():
                self._waiting.add(k)
        return concatenate(parts)

    def _ever_sent(self, world: WorldMap) -> Mask:
        """(N + 1,) whether a landmark was ever sent; the last entry is for id -1: False."""
        size = len(world.landmarks) + 1
        if self._sent is None:
            self._sent = np.append(was_sent(world, world.keyframes.values()), False)
        if (more := size - len(self._sent)) > 0:
            self._sent = np.append(self._sent, np.zeros(more, bool))
        return self._sent


def was_sent(world: WorldMap, keyframes: Iterable[Keyframe]) -> Mask:
    """Mask (N,) of landmarks that one of the keyframes has sent to the graph, and still observes.

    Marginalised landmarks are among them.
    """
    sent = np.zeros(len(world.landmarks) + 1, bool)  # the last entry is for id -1
    for keyframe in keyframes:
        sent[keyframe.sent_ids] = True
    return sent[:-1]


def read_back(world: WorldMap, estimate: GraphEstimate) -> None:
    """Write the graph's poses and points into the map.

    Landmarks outside the graph move rigidly with the keyframe that made them.
    """
    landmarks = world.landmarks
    before = landmarks.in_graph.copy()
    inside = estimate.landmark_ids[landmarks.in_map[estimate.landmark_ids]]
    landmarks.in_graph[:] = False  # nor those that were sent and refused
    landmarks.in_graph[inside] = True
    excluded = np.append(before & ~landmarks.in_graph, False)
    if excluded.any():  # their observations may be sent again later
        for keyframe in world.observing(np.flatnonzero(excluded)):
            keyframe.sent_ids[excluded[keyframe.sent_ids]] = -1
            world.changed.add(keyframe.id)
    keyframes = [world.keyframes.get(i) for i in estimate.keyframe_ids.tolist()]
    present = [k for k in keyframes if k is not None]
    known = np.array([k is not None for k in keyframes], bool)
    ids, T_new = estimate.keyframe_ids[known], estimate.poses_world_camera[known]
    T_old = np.array([k.T_world_camera for k in present]).reshape(-1, 4, 4)
    change = np.abs(T_new - T_old).max(axis=(1, 2))
    moved = change > 1e-9
    outside = np.flatnonzero(landmarks.in_map & ~landmarks.in_graph)
    if moved.any():
        landmarks.move_with_hosts(outside, ids[moved], T_old[moved], T_new[moved])
    for row in np.flatnonzero(change):
        present[row].T_world_camera = T_new[row]
    position = np.searchsorted(estimate.landmark_ids, inside)
    landmarks.points_world[inside] = estimate.points_world[position]
