"""Which landmarks a keyframe sees, by the time its masks arrive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask, step_of
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.labelling.label_views import LabelView
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_editor import MapReader
from bmask_slam.world.world_map import WorldMap

_REACH = 0.02
"""Largest distance of a visible landmark from the depth image, as a share of its depth."""
_NINE = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(9, 2)


@dataclass(frozen=True, eq=False)
class Observed:
    """Pixels (N, 2), as detected, and landmark ids (N,) of a keyframe or label view.

    Its pose is relative to a keyframe of the map, ``anchor``: itself, or the parent of one that was
    culled or of a label view.
    """

    pixels: Array
    landmark_ids: Ints
    anchor: Keyframe
    T_anchor_camera: Array

    @property
    def T_world_camera(self) -> Array:
        return self.anchor.T_world_camera @ self.T_anchor_camera

    def among(self, selected: Mask) -> Observed:
        """Those of ``selected``, a mask over all landmarks."""
        keep = selected[self.landmark_ids]
        return replace(self, pixels=self.pixels[keep], landmark_ids=self.landmark_ids[keep])

    def located(self, world: WorldMap) -> VisibleLandmarks:
        """Its landmarks, with their depths at the present pose."""
        T_world_camera = self.T_world_camera
        points = world.landmarks.points_world[self.landmark_ids]
        z_m = transform(inverse(T_world_camera), points)[:, 2]
        return VisibleLandmarks(
            self.pixels, z_m, self.landmark_ids, T_world_camera, self.anchor.segment
        )


@dataclass(frozen=True, eq=False)
class VisibleLandmarks:
    """Landmarks in a keyframe's image: pixels (N, 2), depths (N,) in m, ids (N,).

    The keyframe is at ``T_world_camera`` in a map segment.
    """

    pixels: Array
    z_m: Array
    landmark_ids: Ints
    T_world_camera: Array
    segment: int

    def with_visible(self, depth_m: Floats, camera: Camera, world: WorldMap) -> VisibleLandmarks:
        """These and all ``visible_landmarks`` of the map."""
        found = visible_landmarks(
            Views(self.T_world_camera[None], np.array([self.segment]), depth_m[None]),
            camera,
            world,
            world.landmarks.in_map,
            (np.zeros(len(self.landmark_ids), np.int64), self.landmark_ids),
        )
        return VisibleLandmarks(
            np.concatenate([self.pixels, found.pixels]),
            np.concatenate([self.z_m, found.z_m]),
            np.concatenate([self.landmark_ids, found.landmark_ids]),
            self.T_world_camera,
            self.segment,
        )


@dataclass(frozen=True, eq=False)
class Views:
    """V keyframes at poses (V, 4, 4) in map segments (V,), with depth images in m.

    Of the latter every s-th pixel each way: (V, H / s, W / s).
    """

    T_world_camera: Array
    segments: Ints
    depth_m: Floats


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks (N,) in images of views (N,), at pixels (N, 2) and depths (N,) in m."""

    views: Ints
    landmark_ids: Ints
    pixels: Array
    z_m: Array

    def select(self, rows: Ints) -> Sightings:
        """Some of them, in the order of ``rows``."""
        return Sightings(
            self.views[rows], self.landmark_ids[rows], self.pixels[rows], self.z_m[rows]
        )

    @classmethod
    def joined(cls, parts: Sequence[Sightings]) -> Sightings:
        """All of several, one after another."""
        nothing = np.zeros(0, np.int64)
        return cls(
            np.concatenate([nothing, *(p.views for p in parts)]),
            np.concatenate([nothing, *(p.landmark_ids for p in parts)]),
            np.concatenate([np.zeros((0, 2)), *(p.pixels for p in parts)]),
            np.concatenate([np.zeros(0), *(p.z_m for p in parts)]),
        )


def visible_landmarks(
    seen_from: Views,
    camera: Camera,
    world: WorldMap,
    selected: Mask,
    known: tuple[Ints, Ints],
) -> Sightings:
    """Landmarks of a view's segment on the surface that its depth image shows.

    The nearest nine of its pixels are compared: at the border of an object, where many landmarks
    are, colour and depth disagree by a pixel or two. ``selected`` is a mask over all landmarks;
    ``known`` are views (N,) and landmarks (N,) which are left out. The result is in the order of
    views, and of landmarks within one.
    """
    landmarks = world.landmarks
    ids = np.flatnonzero(selected)
    wanted = np.zeros((len(seen_from.segments), len(ids)), bool)
    for segment in np.unique(seen_from.segments).tolist():
        hosts = [k.id for k in world.in_segment(segment)]
        wanted[seen_from.segments == segment] = np.isin(landmarks.host[ids], hosts)
    there = selected[known[1]]
    wanted[known[0][there], np.searchsorted(ids, known[1][there])] = False
    local = transform(inverse(seen_from.T_world_camera), landmarks.points_world[ids])
    views, rows = np.nonzero(wanted & (local[..., 2] > 0.1))
    pixels = camera.project_distorted(local[views, rows])
    whole = np.rint(pixels)
    inside = ((whole >= 0) & (whole < [camera.width, camera.height])).all(axis=1)
    views, rows, pixels = views[inside], rows[inside], pixels[inside]
    size = seen_from.depth_m.shape[1:]
    nearest = whole[inside, ::-1].astype(np.int64) // step_of(camera.height, size[0])
    v, u = np.moveaxis(np.clip(nearest[:, None] + _NINE, 0, np.array(size) - 1), -1, 0)
    z_m = local[views, rows, 2]
    apart_m = np.abs(seen_from.depth_m[views[:, None], v, u] - z_m[:, None])
    on_surface = (apart_m < _REACH * z_m[:, None]).any(axis=1)
    views, rows = views[on_surface], rows[on_surface]
    return Sightings(views, ids[rows], pixels[on_surface], z_m[on_surface])


def observed_by(
    keyframe_id: int, map_reader: MapReader, label_views: Mapping[int, LabelView]
) -> Observed | None:
    """The landmarks of the map that a keyframe, which may be culled, or a label view observes."""
    world = map_reader.world
    keyframe = world.keyframes.get(keyframe_id)
    if keyframe is not None:
        rows, ids = world.observed(keyframe)
        return Observed(keyframe.features.image_pixels[rows], ids, keyframe, np.eye(4))
    view, own_id, T_own_camera = label_views.get(keyframe_id), keyframe_id, np.eye(4)
    if view is not None:
        own_id, T_own_camera = view.parent_id, view.T_parent_camera
    parent_id, T_parent_own = map_reader.history.parent(own_id)
    seen, parent = view or world.culled.get(keyframe_id), world.keyframes.get(parent_id)
    if seen is None or parent is None:
        return None
    there = (seen.landmark_ids >= 0) & (seen.landmark_ids < len(world.landmarks))
    rows = np.flatnonzero(there)
    ids = world.landmarks.current(seen.landmark_ids[rows])
    existing = world.landmarks.in_map[ids]
    pixels = seen.image_pixels[rows[existing]]
    return Observed(pixels, ids[existing], parent, T_parent_own @ T_own_camera)
