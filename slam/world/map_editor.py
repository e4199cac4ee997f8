"""How the front end reads and edits a map that a back end owns.

The back end may be in this process (`back_end.mapper`) or in another (`live.processes`).
"""

from __future__ import annotations

from typing import Protocol

from bmask_slam.features.descriptor_index import DescriptorIndex
from bmask_slam.graph.arrays import Ints, Mask
from bmask_slam.graph.sensors.odometry import MotionSensor
from bmask_slam.world.appearance import Patches
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap


class MapReader(Protocol):
    """A map to track against. Its parts may be replaced: ask for them anew at each use."""

    @property
    def world(self) -> WorldMap:
        """Keyframes and landmarks."""

    @property
    def history(self) -> FrameHistory:
        """The tracked frames, and which keyframe stands for a culled one."""

    @property
    def places(self) -> DescriptorIndex:
        """Finds the keyframes that look like a frame."""

    @property
    def sensors(self) -> MotionSensor:
        """Knows the camera's motion without images, where there is odometry."""

    @property
    def idle(self) -> bool:
        """Whether the back end waits for work."""

    @property
    def accepts_keyframes(self) -> bool:
        """Whether a keyframe that is inserted now will be worked on."""

    @property
    def landmarks_ahead(self) -> Ints:
        """Landmarks (N,) of keyframes that the back end has not worked on yet.

        They are as they were measured, may be of what moves, and may be there twice.
        """


class MapEditor(MapReader, Protocol):
    """A map from which observations of moving things are taken, and to which they come back."""

    def prune_mask(self, keyframe_id: int, mask: Mask, widen_px: int) -> None:
        """Take out what a keyframe observes under a mask (H, W), widened by ``widen_px``.

        The keypoints there observe nothing until they are restored.
        """

    def prune_landmarks(self, landmark_ids: Ints) -> None:
        """Take landmarks (N,) out of map and graph, with all their observations."""

    def restore_observations(self, keyframe_id: int, keypoints: Ints, patches: Patches) -> None:
        """Keypoints (N,) of a keyframe that were masked observe landmarks again.

        They observe landmarks that the map has by now, or new ones. Either get the image patches
        (N) of what the keypoints observed before, unless they have patches already.
        """
