"""A keyframe of the map, and what is kept of one that was culled."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Ints, Mask


@dataclass
class Keyframe:
    """A frame that stays in the map.

    Attributes:
        id: position among all keyframes ever made, from 0.
        frame_index, timestamp_s: of the frame it was.
        segment: map segment it belongs to.
        T_world_camera: (4, 4), replaced whenever the graph was optimised.
        features: its keypoints.
        landmark_ids: (N,) landmark of every keypoint, -1 for none.
        sent_ids: (N,) the landmark for which a keypoint's observation was sent to the graph, or -1.
        masked: (N,) keypoints on something that moves: they observe no landmark and make none.
        revision: rises with each change of its observations or masks by ``WorldMap``.
    """

    id: int
    frame_index: int
    timestamp_s: float
    segment: int
    T_world_camera: Array
    features: Features
    landmark_ids: Ints
    sent_ids: Ints = field(init=False)
    masked: Mask = field(init=False)
    revision: int = 0

    def __post_init__(self) -> None:
        self.sent_ids = np.full(len(self.landmark_ids), -1, np.int64)
        self.masked = np.zeros(len(self.landmark_ids), bool)

    @property
    def free(self) -> Mask:
        """Mask (N,) of the keypoints that observe no landmark and are not masked."""
        return (self.landmark_ids < 0) & ~self.masked


@dataclass(frozen=True)
class CulledKeyframe:
    """What late masks of a culled keyframe need: image_pixels (N, 2) and landmark_ids (N,)."""

    image_pixels: Array
    landmark_ids: Ints
