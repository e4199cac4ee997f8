"""Votes of keyframes' masks on the labels of landmarks, also of landmarks made later."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask, step_of
from bmask_slam.graph.camera import Camera
from bmask_slam.labelling.label_views import LabelViews
from bmask_slam.labelling.landmark_visibility import (
    Observed,
    Sightings,
    Views,
    observed_by,
    visible_landmarks,
)
from bmask_slam.labelling.remembered_masks import RememberedMasks
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import viewpoint_cells
from bmask_slam.semantics.beliefs.pixel_assignment import PixelAssignment
from bmask_slam.semantics.beliefs.surface_geometry import by_height
from bmask_slam.semantics.beliefs.surface_store import (
    SurfaceEstimates,
    SurfaceStore,
    with_things,
)
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.beliefs.votes import PixelStack, vote_in_views
from bmask_slam.semantics.instances.surfaces import SurfaceClasses
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.world.map_editor import MapReader

_NOWHERE = -1
"""Segment of a keyframe that has left the map."""


class LabelVotes:
    """Votes of masks on landmarks, for the stores of labels and of surfaces.

    A landmark is often made later than the keyframes that see its place best: in a room that is
    seen again, most are. The masks of the last keyframes therefore vote on new landmarks too, at
    the places where they would have been.
    """

    def __init__(
        self,
        camera: Camera,
        config: VoteConfig,
        map_reader: MapReader,
        labels: LabelStore,
        surfaces: SurfaceStore,
        label_views: LabelViews,
    ) -> None:
        self._camera, self._config, self._map = camera, config, map_reader
        self._labels, self._surfaces, self._label_views = labels, surfaces, label_views
        self._remembered = RememberedMasks(labels.classes)

    def vote(
        self,
        keyframe_id: int,
        assignment: PixelAssignment,
        observed: Observed,
        seen: SurfaceClasses | None = None,
    ) -> Ints:
        """Let a keyframe's instances and classes of pixels vote on all visible landmarks.

        The ids (N,) are those of the landmarks that the instances voted on.
        """
        world = self._map.world
        new = world.landmarks.in_map.copy()
        new[self._labels.known()] = False
        if new.any():
            self._vote_on_new(new)
        here = observed.located(world).with_visible(assignment.depth_m, self._camera, world)
        views = np.zeros(len(here.landmark_ids), np.int64)
        sightings = Sightings(views, here.landmark_ids, here.pixels, here.z_m)
        stack = PixelStack.of(assignment, self._labels.classes)
        ids = self._vote(stack, sightings, here.T_world_camera[None])
        if seen is not None and len(here.landmark_ids):
            self._surfaces.update(seen.labels, here.landmark_ids, seen.at(here.pixels))
        self._remembered.add(keyframe_id, assignment, seen)
        return ids

    def _vote_on_new(self, new: Mask) -> None:
        """Let the masks of earlier keyframes vote on landmarks, a mask over all, made since."""
        rows = np.array(list(self._remembered.rows.values()), np.int64)
        if not len(rows):
            return
        stack, world = self._remembered.stack(), self._map.world
        poses, segments = np.tile(np.eye(4), (len(rows), 1, 1)), np.full(len(rows), _NOWHERE)
        matched = []
        for keyframe_id, row in self._remembered.rows.items():
            seen = observed_by(keyframe_id, self._map, self._label_views)
            if seen is None:
                continue
            poses[row], segments[row] = seen.T_world_camera, seen.anchor.segment
            seen = seen.among(new)
            if not len(seen.landmark_ids):
                continue
            located = seen.located(world)
            of_row = np.full(len(located.landmark_ids), row)
            matched.append(Sightings(of_row, located.landmark_ids, located.pixels, located.z_m))
        known = Sightings.joined(matched)
        others = visible_landmarks(
            Views(poses, segments, stack.depth_m),
            self._camera,
            world,
            new,
            (known.views, known.landmark_ids),
        )
        turn = np.empty(len(rows), np.int64)
        turn[rows] = np.arange(len(rows))
        sightings = Sightings.joined([known, others])
        sightings = sightings.select(np.argsort(turn[sightings.views], kind="stable"))
        self._vote(stack, sightings, poses)
        parts = self._remembered.surfaces_at(sightings.views, sightings.pixels)
        for labels, numbers, probabilities in parts:
            self._surfaces.update(labels, sightings.landmark_ids[numbers], probabilities)

    def _vote(self, stack: PixelStack, sightings: Sightings, T_world_camera: Array) -> Ints:
        """Let views at poses (V, 4, 4) vote on landmarks, one after another.

        Returns the ids (N,) of those on which they did.
        """
        camera, store = self._camera, self._labels
        if not len(sightings.landmark_ids):
            return sightings.landmark_ids
        scale = step_of(camera.width, stack.owner.shape[2])
        config = replace(self._config, edge_px=-(-self._config.edge_px // scale))
        pixels, z_m = sightings.pixels / scale, sightings.z_m
        votes = vote_in_views(stack, sightings.views, pixels, z_m, config)
        rows, missed = votes.rows, votes.missed
        ids = sightings.landmark_ids[rows]
        positions = T_world_camera[sightings.views[rows], :3, 3]
        cells = viewpoint_cells(self._map.world.landmarks.points_world[ids], positions)
        misses = votes.weights[missed, None]
        if store.model is not None:
            expected = store.model.group_recall(z_m[rows[missed]], camera.fx, camera.width)
            misses = (misses * expected).astype(np.float32)
        told = votes.distributions[~missed], votes.weights[~missed]
        store.fuse(ids, missed, told, misses, cells)
        return ids

    def surfaces(
        self, ids: Ints, poses: dict[int, Array], up_world: Array, things: LabelSet
    ) -> SurfaceEstimates | None:
        """What landmarks (N,) lie on, seen by cameras at these poses; None if not known.

        Labels of ``things`` tell it too.
        """
        store, points = self._surfaces, self._map.world.landmarks.points_world[ids]
        if len(store.names) < 2:
            return None
        cameras = np.array([T[:3, 3] for T in poses.values()]).reshape(-1, 3)
        p = by_height(store.names, store.probabilities(ids), points, cameras, up_world)
        p = with_things(store.names, p, things, self._labels.probabilities(ids))
        return SurfaceEstimates.of(store.names, p)

    def state(self) -> Arrays:
        """The masks of the last keyframes, as named arrays."""
        return self._remembered.state(self._surfaces.names)

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        self._remembered = RememberedMasks(self._labels.classes)
        self._remembered.restore(state, self._surfaces.names, self._camera.height)
