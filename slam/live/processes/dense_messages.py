"""Messages between tracking and the dense map's process."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path

from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.graph.arrays import Array, Bytes, Floats, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

logger = logging.getLogger(__name__)


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
    """

    run: Path
    camera: Camera
    masks: SegmenterOptions
    labels: tuple[str, ...]
    shown: int = 0
    mesh_voxel_m: float | None = None


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
    """

    points: int = 0
    missing: list[int] = field(default_factory=list)
    failure: str = ""

    def log_missing(self, run: Path, has_images: bool) -> None:
        """Log how the map of a run is completed, if it has to be."""
        if self.failure:
            logger.error("%s; bmask-slam map %s completes it", self.failure, run)
        elif self.missing:
            cure = "adds" if has_images else "with their images as --sequence adds"
            text = "bmask-slam map %s %s the %d keyframes left out"
            logger.warning(text, run, cure, len(self.missing))
