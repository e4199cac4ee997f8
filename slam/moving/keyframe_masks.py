"""What a keyframe's masks tell those who ask whether things move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.moving.free_space_check import thinned_view
from bmask_slam.semantics.beliefs.votes import PixelAssignment
from bmask_slam.semantics.labels import LabelSet

_SAMPLES = 400
"""Points of an instance, at most."""


@dataclass(frozen=True, eq=False)
class KeyframeMasks:
    """A keyframe's instances and what they say about its landmarks.

    Attributes:
        keyframe_id: its. names: the label set.
        claims: who owns its pixels. depth_m: every s-th pixel of its depth, NaN where missing.
        T_world_camera: its pose.
        landmark_ids: (N,) that were spoken of. instances: (N,) the claims' that each is on, -1
            for none. label_distributions: (N, C) what is known of their classes.
    """

    keyframe_id: int
    names: LabelSet
    assignment: PixelAssignment
    depth_m: Floats
    T_world_camera: Array
    landmark_ids: Ints
    instances: Ints
    label_distributions: Array

    @property
    def step(self) -> int:
        """Every how many pixels there is a depth."""
        return max(self.assignment.owner.shape[0] // max(self.depth_m.shape[0], 1), 1)


@dataclass(frozen=True, eq=False)
class Surface:
    """Some points on an instance's surface.

    Attributes:
        points: (N, 3) m, in the camera's frame.
        complete: (N,) no depth is missing around it, as other frames ask it to be.
    """

    points: Array
    complete: Mask


def surfaces(
    camera: Camera, masks: KeyframeMasks, window_px: int, at_least: int
) -> list[Surface | None]:
    """The surface of each of a keyframe's instances; None where fewer pixels have depth."""
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
