"""Votes of keyframes' masks on the labels of landmarks, also of landmarks made later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.labelling.landmark_visibility import Observed, VisibleLandmarks, observed_by
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import viewpoint_cells
from bmask_slam.semantics.beliefs.surface_geometry import by_height
from bmask_slam.semantics.beliefs.surface_store import SurfaceEstimates, SurfaceStore
from bmask_slam.semantics.beliefs.votes import PixelAssignment, VoteConfig, vote
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import SurfaceClasses
from bmask_slam.world.map_editor import MapReader

RECENT = 8
"""Number of keyframes whose masks vote on landmarks that are made later."""
_NO_MASK = np.zeros((0, 0), bool)


class LabelVotes:
    """Votes of masks on landmarks, for a label store.

    A landmark is often made later than the keyframes that see its place best. The masks of the last
    RECENT keyframes therefore vote on new landmarks too, at the places where they would have been.
    """

    _recent: dict[int, PixelAssignment]

    def __init__(self, camera: Camera, config: VoteConfig, map_reader: MapReader) -> None:
        self._camera, self._config, self._map = camera, config, map_reader
        self._recent = {}

    def vote(
        self, keyframe_id: int, assignment: PixelAssignment, observed: Observed, store: LabelStore
    ) -> tuple[Ints, VisibleLandmarks]:
        """Let a keyframe's instances vote on all visible landmarks, which are returned too.

        The ids (N,) are those of the landmarks that were voted on.
        """
        world = self._map.world
        new = world.landmarks.in_map.copy()
        new[store.known()] = False
        for earlier_id, earlier in self._recent.items():
            visible = observed_by(earlier_id, self._map)
            if visible is not None:
                matched = visible.located(world).among(new)
                located = matched.with_visible(earlier.depth_m, self._camera, world, new)
                self._vote(earlier, located, store)
        located = observed.located(world).with_visible(assignment.depth_m, self._camera, world)
        ids = self._vote(assignment, located, store)
        without = [replace(i, mask=_NO_MASK) for i in assignment.instances]
        self._recent[keyframe_id] = replace(assignment, instances=tuple(without))
        if len(self._recent) > RECENT:
            del self._recent[min(self._recent)]
        return ids, located

    def _vote(
        self, assignment: PixelAssignment, visible: VisibleLandmarks, store: LabelStore
    ) -> Ints:
        votes = vote(assignment, visible.pixels, visible.z_m, store.classes, self._config)
        ids, hit = visible.landmark_ids[votes.rows], ~votes.missed
        points_world = self._map.world.landmarks.points_world[ids]
        cells = viewpoint_cells(points_world, visible.T_world_camera[:3, 3])
        store.update(ids[hit], votes.distributions[hit], votes.weights[hit], cells[hit])
        missed = votes.weights[~hit]
        if store.model is not None:
            z_m, camera = visible.z_m[votes.rows[~hit]], self._camera
            expected = store.model.group_recall(z_m, camera.fx, camera.width)
            missed = (missed[:, None] * expected).astype(np.float32)
        store.miss(ids[~hit], missed, cells[~hit])
        return ids

    def state(self) -> Arrays:
        """The masks of the last keyframes, as named arrays."""
        views = list(self._recent.values())
        instances = [i for c in views for i in c.instances]
        return {
            "keyframes": np.array(list(self._recent), np.int64),
            "shape": np.array([v.owner.shape for v in views], np.int64).ravel(),
            "depth_shape": np.array([v.depth_m.shape for v in views], np.int64).ravel(),
            "owner": np.array([v.owner for v in views], np.int16).ravel(),
            "under": np.array([v.under for v in views], np.int16).ravel(),
            "inner": np.array([v.inner for v in views], bool).ravel(),
            "depth_m": np.array([v.depth_m for v in views], np.float32).ravel(),
            "ranges_m": np.concatenate([np.zeros(0), *(v.depth_range_m.ravel() for v in views)]),
            "counts": np.array([len(v.instances) for v in views], np.int64),
            "boxes": np.array([i.box for i in instances], np.float32).ravel(),
            "labels": np.array([i.label for i in instances], np.int64),
            "distributions": np.array([i.distribution for i in instances], np.float32).ravel(),
            "scores": np.array([(i.class_score, i.mask_score) for i in instances], float).ravel(),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        count = len(state["keyframes"])
        shape, depth_shape = (state[n][:2].tolist() for n in ("shape", "depth_shape"))
        images = {n: state[n].reshape(count, *shape) for n in ("owner", "under", "inner")}
        depths_m = state["depth_m"].reshape(count, *depth_shape)
        ranges_m = state["ranges_m"].reshape(-1, 2)
        instances, ends = _instances(state), np.cumsum(state["counts"])
        self._recent = {}
        for k, keyframe_id in enumerate(state["keyframes"].tolist()):
            rows = slice(ends[k] - state["counts"][k], ends[k])
            owner, under, inner = (images[n][k] for n in ("owner", "under", "inner"))
            self._recent[keyframe_id] = PixelAssignment(
                tuple(instances[rows]), owner, under, inner, depths_m[k], ranges_m[rows]
            )


def vote_on_surfaces(
    seen: SurfaceClasses | None, visible: VisibleLandmarks, store: SurfaceStore
) -> None:
    """Let the classes of a keyframe's pixels vote on the landmarks there, if it has them."""
    if seen is not None:
        store.update(seen.labels, visible.landmark_ids, seen.at(visible.pixels))


def estimated_surfaces(
    store: SurfaceStore, ids: Ints, points_world: Array, poses: dict[int, Array], up_world: Array
) -> SurfaceEstimates | None:
    """What landmarks (N,) at (N, 3) lie on, seen by cameras at these poses; None if not known."""
    if len(store.names) < 2:
        return None
    cameras = np.array([T[:3, 3] for T in poses.values()]).reshape(-1, 3)
    p = by_height(store.names, store.probabilities(ids), points_world, cameras, up_world)
    return SurfaceEstimates.of(store.names, p)


def _instances(state: Arrays) -> Sequence[Instance]:
    boxes, count = state["boxes"].reshape(-1, 4), max(len(state["labels"]), 1)
    distributions = state["distributions"].reshape(-1, max(len(state["distributions"]) // count, 1))
    scores = state["scores"].reshape(-1, 2).tolist()
    return [
        Instance(_NO_MASK, box, label, distribution, *score)
        for box, label, distribution, score in zip(
            boxes, state["labels"].tolist(), distributions, scores, strict=True
        )
    ]
