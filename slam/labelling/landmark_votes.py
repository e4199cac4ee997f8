"""Votes of keyframes' masks on the labels of landmarks, also of landmarks made later."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.labelling.landmark_visibility import Observed, VisibleLandmarks, observed_by
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.beliefs.observation import viewpoint_cells
from bmask_slam.semantics.beliefs.surface_geometry import by_height
from bmask_slam.semantics.beliefs.surface_store import (
    SurfaceEstimates,
    SurfaceStore,
    with_things,
)
from bmask_slam.semantics.beliefs.votes import PixelAssignment, VoteConfig, vote
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import CodedSurfaces, SurfaceClasses, coded
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.world.map_editor import MapReader

REMEMBERED = 100
"""Number of keyframes whose masks vote on landmarks that are made later."""
THINNED = 4
"""Of their masks and depth images every so many pixels are kept each way."""
_NO_MASK = np.zeros((0, 0), bool)


@dataclass(frozen=True, eq=False)
class _Remembered:
    """What a keyframe's masks say, and the classes of all its pixels, if it has them."""

    assignment: PixelAssignment
    surfaces: SurfaceClasses | CodedSurfaces | None


class LabelVotes:
    """Votes of masks on landmarks, for the stores of labels and of surfaces.

    A landmark is often made later than the keyframes that see its place best: in a room that is
    seen again, most are. The masks of the last REMEMBERED keyframes therefore vote on new landmarks
    too, at the places where they would have been.
    """

    _remembered: dict[int, _Remembered]

    def __init__(
        self,
        camera: Camera,
        config: VoteConfig,
        map_reader: MapReader,
        labels: LabelStore,
        surfaces: SurfaceStore,
    ) -> None:
        self._camera, self._config, self._map = camera, config, map_reader
        self._labels, self._surfaces = labels, surfaces
        self._remembered = {}

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
        for earlier_id, earlier in self._remembered.items() if new.any() else ():
            visible = observed_by(earlier_id, self._map)
            if visible is not None:
                matched = visible.located(world).among(new)
                depth_m = earlier.assignment.depth_m
                located = matched.with_visible(depth_m, self._camera, world, new)
                self._vote(earlier, located)
        located = observed.located(world).with_visible(assignment.depth_m, self._camera, world)
        ids = self._vote(_Remembered(assignment, seen), located)
        codes = None if seen is None else coded(seen)
        self._remembered[keyframe_id] = _Remembered(_thinned(assignment), codes)
        if len(self._remembered) > REMEMBERED:
            del self._remembered[min(self._remembered)]
        return ids

    def _vote(self, view: _Remembered, visible: VisibleLandmarks) -> Ints:
        if not len(visible.landmark_ids):
            return visible.landmark_ids
        store, scale = self._labels, self._camera.width // view.assignment.owner.shape[1]
        config = replace(self._config, edge_px=-(-self._config.edge_px // scale))
        pixels = visible.pixels / scale
        votes = vote(view.assignment, pixels, visible.z_m, store.classes, config)
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
        if (seen := view.surfaces) is not None:
            self._surfaces.update(seen.labels, visible.landmark_ids, seen.at(visible.pixels))
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
        views = [v.assignment for v in self._remembered.values()]
        instances = [i for c in views for i in c.instances]
        return {
            "keyframes": np.array(list(self._remembered), np.int64),
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
            **_surface_arrays(self._surfaces.names, list(self._remembered.values())),
        }

    def restore(self, state: Arrays) -> None:
        """Go on from a state."""
        count = len(state["keyframes"])
        shape, depth_shape = (state[n][:2].tolist() for n in ("shape", "depth_shape"))
        images = {n: state[n].reshape(count, *shape) for n in ("owner", "under", "inner")}
        depths_m = state["depth_m"].reshape(count, *depth_shape)
        ranges_m = state["ranges_m"].reshape(-1, 2)
        instances, ends = _instances(state), np.cumsum(state["counts"])
        surfaces = _restored_surfaces(self._surfaces.names, state, count)
        self._remembered = {}
        for k, keyframe_id in enumerate(state["keyframes"].tolist()):
            rows = slice(ends[k] - state["counts"][k], ends[k])
            owner, under, inner = (images[n][k] for n in ("owner", "under", "inner"))
            kept = tuple(instances[rows]), owner, under, inner, depths_m[k], ranges_m[rows]
            assignment = PixelAssignment(*kept)
            if len(owner) == self._camera.height:  # older versions kept them whole
                assignment = _thinned(assignment)
            self._remembered[keyframe_id] = _Remembered(assignment, surfaces[k])


def _surface_arrays(names: LabelSet, views: Sequence[_Remembered]) -> Arrays:
    """Their codes as named arrays; keyframes without them have none."""
    kept = [(k, v.surfaces) for k, v in enumerate(views) if isinstance(v.surfaces, CodedSurfaces)]
    own = [(k, c) for k, c in kept if c.labels == names]
    return {
        "coded": np.array([k for k, _ in own], np.int64),
        "cell_px": np.array([c.cell_px for _, c in own], float),
        "codes_shape": np.array([c.codes.shape for _, c in own], np.int64).ravel(),
        "codes": np.concatenate([np.zeros(0, np.uint16), *(c.codes.ravel() for _, c in own)]),
    }


def _restored_surfaces(names: LabelSet, state: Arrays, count: int) -> list[CodedSurfaces | None]:
    """The inverse, of ``count`` keyframes; states of older versions have none."""
    found: list[CodedSurfaces | None] = [None] * count
    if "coded" not in state:
        return found
    shapes, start = state["codes_shape"].reshape(-1, 2).tolist(), 0
    rows = zip(state["coded"].tolist(), shapes, state["cell_px"].tolist(), strict=True)
    for k, (height, width), cell_px in rows:
        codes = state["codes"][start : start + height * width].reshape(height, width)
        found[k] = CodedSurfaces(names, codes, cell_px)
        start += height * width
    return found


def _thinned(assignment: PixelAssignment) -> PixelAssignment:
    """Every THINNED-th pixel each way of a keyframe's masks and depth, without those masks."""
    step = THINNED * assignment.depth_m.shape[0] // assignment.owner.shape[0]
    every = np.s_[::THINNED, ::THINNED]
    owner, under = assignment.owner[every].copy(), assignment.under[every].copy()
    inner = assignment.inner[every].copy()
    depth_m = assignment.depth_m[:: max(step, 1), :: max(step, 1)].copy()
    without = tuple(replace(i, mask=_NO_MASK) for i in assignment.instances)
    return PixelAssignment(without, owner, under, inner, depth_m, assignment.depth_range_m)


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
