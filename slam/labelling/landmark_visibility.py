"""Which landmarks a keyframe sees, by the time its masks arrive."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.world.map_editor import MapReader
from bmask_slam.world.world_map import Keyframe, WorldMap

_REACH = 0.02
"""Largest distance of a visible landmark from the depth image, as a share of its depth."""
_NINE = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(9, 2)


@dataclass(frozen=True, eq=False)
class Observed:
    """Pixels (N, 2), as detected, and landmark ids (N,) of a keyframe, which may be culled.

    Its pose is relative to a keyframe of the map, ``anchor``: itself or its parent.
    """

    pixels: Array
    landmark_ids: Ints
    anchor: Keyframe
    T_anchor_camera: Array

    @property
    def T_world_camera(self) -> Array:
        return self.anchor.T_world_camera @ self.T_anchor_camera

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

    def among(self, selected: Mask) -> VisibleLandmarks:
        """Those that are ``wanted``, a mask over all landmarks."""
        keep = selected[self.landmark_ids]
        kept = self.pixels[keep], self.z_m[keep], self.landmark_ids[keep]
        return VisibleLandmarks(*kept, self.T_world_camera, self.segment)

    def with_visible(
        self, depth_m: Floats, camera: Camera, world: WorldMap, selected: Mask | None = None
    ) -> VisibleLandmarks:
        """These and others of the segment on the surface that the keyframe's depth image shows.

        The nearest nine of ``depth_m`` (H / s, W / s), every s-th pixel of the depth image, are
        compared: at the border of an object, where many landmarks are, colour and depth disagree by
        a pixel or two. ``wanted`` is a mask over all landmarks; without it all in the map are used.
        """
        landmarks = world.landmarks
        others = (landmarks.in_map if selected is None else selected).copy()
        others[self.landmark_ids] = False
        ids = np.flatnonzero(others)
        hosts = [k.id for k in world.in_segment(self.segment)]
        ids = ids[np.isin(landmarks.host[ids], hosts)]
        local = transform(inverse(self.T_world_camera), landmarks.points_world[ids])
        ahead = np.flatnonzero(local[:, 2] > 0.1)
        pixels = camera.project_distorted(local[ahead])
        whole = np.rint(pixels)
        inside = ((whole >= 0) & (whole < [camera.width, camera.height])).all(axis=1)
        rows, pixels = ahead[inside], pixels[inside]
        step = camera.height // depth_m.shape[0]
        limits = np.array(depth_m.shape) - 1
        nearest = whole[inside, ::-1].astype(np.int64) // step
        v, u = np.moveaxis(np.clip(nearest[:, None] + _NINE, 0, limits), -1, 0)
        z_m = local[rows, 2]
        on_surface = (np.abs(depth_m[v, u] - z_m[:, None]) < _REACH * z_m[:, None]).any(axis=1)
        return VisibleLandmarks(
            np.concatenate([self.pixels, pixels[on_surface]]),
            np.concatenate([self.z_m, z_m[on_surface]]),
            np.concatenate([self.landmark_ids, ids[rows[on_surface]]]),
            self.T_world_camera,
            self.segment,
        )


def observed_by(keyframe_id: int, map_reader: MapReader) -> Observed | None:
    """The landmarks of the map that a keyframe, which may be culled, observes."""
    world = map_reader.world
    keyframe = world.keyframes.get(keyframe_id)
    if keyframe is not None:
        rows, ids = world.observed(keyframe)
        return Observed(keyframe.features.image_pixels[rows], ids, keyframe, np.eye(4))
    culled = world.culled.get(keyframe_id)
    parent_id, T_parent_keyframe = map_reader.history.parent(keyframe_id)
    parent = world.keyframes.get(parent_id)
    if culled is None or parent is None:
        return None
    rows = np.flatnonzero(culled.landmark_ids >= 0)
    ids = world.landmarks.current(culled.landmark_ids[rows])
    existing = world.landmarks.in_map[ids]
    return Observed(culled.image_pixels[rows[existing]], ids[existing], parent, T_parent_keyframe)
