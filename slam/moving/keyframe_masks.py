"""The masks of a keyframe, as evidence of motion, and the surfaces that they cover."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask, step_of
from bmask_slam.graph.camera import Camera
from bmask_slam.moving.free_space_check import thinned_view
from bmask_slam.semantics.beliefs.pixel_assignment import PixelAssignment
from bmask_slam.semantics.labels import LabelSet

_SAMPLES = 400
"""Largest number of points of an instance."""


@dataclass(frozen=True, eq=False)
class KeyframeMasks:
    """A keyframe's instances, and the landmarks that lie on them.

    Attributes:
        keyframe_id: of the keyframe, or the number of a label view.
        timestamp_s: of its frame, NaN if not known.
        anchor_id, T_anchor_camera: a keyframe of the map, itself if it is one, and its pose (4, 4)
            relative to that.
        names: the label set.
        assignment: the instance of every pixel.
        depth_m: (H / s, W / s) every s-th pixel of the depth image, NaN where missing.
        T_world_camera: (4, 4).
        landmark_ids: (N,) landmarks that the masks voted on.
        instances: (N,) index of the instance that each landmark is on, -1 for none.
        label_distributions: (N, C) P(class) of each landmark.
    """

    keyframe_id: int
    timestamp_s: float
    anchor_id: int
    T_anchor_camera: Array
    names: LabelSet
    assignment: PixelAssignment
    depth_m: Floats
    T_world_camera: Array
    landmark_ids: Ints
    instances: Ints
    label_distributions: Array

    @property
    def of_keyframe(self) -> bool:
        """Whether they are of a keyframe of the map."""
        return self.keyframe_id == self.anchor_id

    @property
    def step(self) -> int:
        """Pixels from one depth to the next."""
        return step_of(self.assignment.owner.shape[0], self.depth_m.shape[0])


@dataclass(frozen=True, eq=False)
class Surface:
    """Some points on an instance's surface.

    Attributes:
        points: (N, 3) m, in the camera's frame.
        complete: (N,) whether no depth is missing in the window around it.
    """

    points: Array
    complete: Mask


def surfaces(
    camera: Camera, masks: KeyframeMasks, window_px: int, at_least: int
) -> list[Surface | None]:
    """The surface of each instance of a keyframe; None with fewer than ``at_least`` points."""
    view = thinned_view(masks.depth_m.copy(), masks.step, window_px)
    instances = range(len(masks.assignment.instances))
    return [_surface(camera, masks, k, view.nearest_m > 0, at_least) for k in instances]


def _surface(
    camera: Camera, masks: KeyframeMasks, k: int, complete: Mask, at_least: int
) -> Surface | None:
    depth_m, step = masks.depth_m, masks.step
    owner = masks.assignment.owner[::step, ::step][: depth_m.shape[0], : depth_m.shape[1]]
    rows, columns = np.nonzero((owner == k) & np.isfinite(depth_m))
    z_m = depth_m[rows, columns].astype(float)
    surface = np.flatnonzero(masks.assignment.on_surface(np.full(len(rows), k), z_m))
    if len(surface) < at_least:
        return None
    some = np.linspace(0, len(surface) - 1, min(len(surface), _SAMPLES)).astype(np.int64)
    chosen = surface[some]
    pixels = step * np.stack([columns[chosen], rows[chosen]], axis=1).astype(float)
    points = camera.backproject(pixels, z_m[chosen])
    return Surface(points, complete[rows[chosen], columns[chosen]])
