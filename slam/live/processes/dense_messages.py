"""Messages between tracking and the dense map's process."""

from __future__ import annotations

import logging
from collections.abc import Set
from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote

import numpy as np

from bmask_slam.dense.growing.frames import FrameOptions
from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

SAME = 1e-4
"""Poses whose numbers differ by less are the same."""


@dataclass(frozen=True)
class DenseSetup:
    """What the process needs to start.

    Attributes:
        run: the run folder.
        camera: of the frames.
        masks: the segmenter that makes the masks.
        labels: names of its classes.
        shown: largest number of points of a submap for a viewer; 0: there is no viewer.
        mesh_voxel_m: as in `MapOptions`.
        frames: which frames the surface gets besides keyframes.
        grows: whether the surface grows on the way, else it is made at the end.
    """

    run: Path
    camera: Camera
    masks: SegmenterOptions
    labels: tuple[str, ...]
    shown: int = 0
    mesh_voxel_m: float | None = None
    frames: FrameOptions = field(default_factory=FrameOptions)
    grows: bool = True


@dataclass(frozen=True, eq=False)
class KeyframeToMap:
    """To the process: a keyframe with its present pose and landmarks.

    Attributes:
        snapshot: the keyframe with its images.
        instances: its masks; empty if none were found or they have not come.
        poses: T_world_camera (4, 4) of it and of the keyframes around it, by id.
    """

    snapshot: KeyframeSnapshot
    instances: list[Instance]
    poses: dict[int, Array]

    @property
    def id(self) -> int:
        """Id of the keyframe."""
        return self.snapshot.id


@dataclass(frozen=True, eq=False)
class LateMasks:
    """To the process: masks of a keyframe sent before; landmark_ids (L,) are at pixels (L, 2)."""

    keyframe_id: int
    instances: list[Instance]
    landmark_ids: Ints
    pixels: Array


@dataclass(frozen=True)
class RemoveKeyframes:
    """To the process: these keyframes are no longer in the map."""

    keyframe_ids: list[int]


@dataclass(frozen=True, eq=False)
class MapPoses:
    """To the process: where keyframes are, for the surface.

    Attributes:
        ids: (N,) keyframes of the largest map segment, and culled ones that frames of it follow.
        poses: (N, 4, 4) their T_world_camera.
    """

    ids: Ints
    poses: Array

    @classmethod
    def of(cls, world: WorldMap, history: FrameHistory, followed: Set[int]) -> MapPoses:
        """As they are now; ``followed`` are keyframes that may have been culled."""
        segment = history.largest_segment(world)
        poses = {k.id: k.T_world_camera for k in world.in_segment(segment)}
        for culled in followed - world.keyframes.keys():
            parent, T_parent_culled = history.parent(culled)
            if parent in poses:
                poses[culled] = poses[parent] @ T_parent_culled
        return cls(
            np.array(list(poses), np.int64), np.array(list(poses.values())).reshape(-1, 4, 4)
        )

    def is_like(self, other: MapPoses) -> bool:
        """Whether the same keyframes are where they were, to a tenth of a millimetre."""
        same = np.array_equal(self.ids, other.ids)
        return same and bool(np.allclose(self.poses, other.poses, rtol=0, atol=SAME))

    def by_id(self) -> dict[int, Array]:
        """T_world_camera (4, 4) by id."""
        return dict(zip(self.ids.tolist(), self.poses, strict=True))


NO_POSES = MapPoses(np.zeros(0, np.int64), np.zeros((0, 4, 4)))


@dataclass(frozen=True)
class ShowSurface:
    """To the process: parts of the surface that change are wanted from now on."""


@dataclass(frozen=True)
class RunMoved:
    """To the process: the run folder is another one from now on."""

    run: Path


@dataclass(frozen=True, eq=False)
class FinishMap:
    """To the process: no more keyframes; the run folder holds the map.

    Attributes:
        poses: T_world_camera (4, 4) of all keyframes, by id.
        skipped: keyframes that were not sent, and why.
    """

    poses: dict[int, Array]
    skipped: dict[int, str]


@dataclass(frozen=True)
class Accepted:
    """From the process: a keyframe has been handled, and another may be sent."""

    keyframe_id: int


@dataclass(frozen=True, eq=False)
class Preview:
    """Some points (N, 3) of a submap in the frame of its keyframe, and colours (N, 3)."""

    points: Floats
    colours: Bytes


@dataclass(frozen=True, eq=False)
class Mapped:
    """From the process: a keyframe's submap is saved; ``preview`` if there is a viewer."""

    keyframe_id: int
    preview: Preview | None = None


@dataclass(frozen=True)
class NotMapped:
    """From the process: a keyframe has no submap, and why."""

    keyframe_id: int
    reason: str
    disk_full: bool = False


@dataclass(frozen=True)
class MapWritten:
    """From the process: the clouds are written.

    Attributes:
        points: in the cloud.
        missing: keyframes of the map without a submap.
        failure: why the clouds are not written; empty if they are.
        frames: in the surface besides keyframes.
    """

    points: int = 0
    missing: list[int] = field(default_factory=list)
    failure: str = ""
    frames: int = 0

    def log_missing(self, run: Path, has_images: bool) -> None:
        """Log how the map of a run is completed, if it has to be."""
        if self.failure:
            logger.error("%s; bmask-slam map %s completes it", self.failure, quote(str(run)))
        elif self.missing:
            cure = "adds" if has_images else "with their images as --sequence adds"
            text = "bmask-slam map %s %s the %d keyframes left out"
            logger.warning(text, quote(str(run)), cure, len(self.missing))
