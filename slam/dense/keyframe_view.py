"""What dense mapping takes of a keyframe: where it stands, what it shows, which landmarks."""

from __future__ import annotations

from dataclasses import dataclass

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.world_map import Keyframe, WorldMap


@dataclass(frozen=True, eq=False)
class SeenKeyframe:
    """A keyframe of the map with its images, as they were taken.

    Attributes:
        id: of the keyframe. segment: map segment.
        T_world_camera: (4, 4).
        frame: its images.
        landmark_ids: (L,) landmarks that it observes. points_world: (L, 3) where they are.
        pixels: (L, 2) where it detected them, distorted as the images are.
    """

    id: int
    segment: int
    T_world_camera: Array
    frame: Frame
    landmark_ids: Ints
    points_world: Array
    pixels: Array


def seen(world: WorldMap, keyframe: Keyframe, frame: Frame) -> SeenKeyframe:
    """A keyframe as it is in the map at this moment."""
    rows, ids = world.observed(keyframe)
    return SeenKeyframe(
        keyframe.id,
        keyframe.segment,
        keyframe.T_world_camera,
        frame,
        ids,
        world.landmarks.points_world[ids],
        keyframe.features.image_pixels[rows],
    )
