"""What the processes of the live loop say to each other: plain values that pickle."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bmask_slam.graph.arrays import Array, Floats, Image, Ints
from bmask_slam.live.replica import WorldDelta
from bmask_slam.semantics.instances.instances import Instance, PackedMask
from bmask_slam.tracking.results import Tracked
from bmask_slam.world.frame_history import Entries
from bmask_slam.world.landmark_table import Patches


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks (N,) with the number of frames that should have seen, and did see, each."""

    ids: Ints
    visible: Ints
    found: Ints


@dataclass(frozen=True, eq=False)
class NewKeyframe:
    """To the map: tracking made a frame a keyframe.

    Attributes:
        id: of the keyframe.
        frame_index, timestamp_s: of the frame.
        tracked: how it was tracked; with the image, from which patches are cut.
        segment: the map segment.
        reference: a keyframe and its pose as tracking knew it, which says where
            ``tracked.T_world_camera`` is; None where the frame begins a segment.
        local_ids: (N,) landmarks that it was tracked against.
        sightings: of the frames since the last keyframe.
        history: the frames since then.
        depth_m: (h, w) every second pixel of its z-depth, for its masks.
    """

    id: int
    frame_index: int
    timestamp_s: float
    tracked: Tracked
    segment: int
    reference: tuple[int, Array] | None
    local_ids: Ints
    sightings: Sightings
    history: Entries
    depth_m: Floats


@dataclass(frozen=True, eq=False)
class LostKeyframe:
    """To the map, in place of a ``NewKeyframe`` that it cannot take in: its frames go to another.

    Attributes:
        id: of the keyframe. heir_id: a keyframe that takes its frames. T_heir_lost: (4, 4).
            A keyframe that began a segment has no heir (NOBODY): the segment begins anew.
        history: as of the ``NewKeyframe``.
        landmarks: ever made, as tracking knows; no id among them means another one from now on.
    """

    id: int
    parent_id: int
    T_parent_lost: Array
    history: Entries
    landmarks: int = 0


@dataclass(frozen=True)
class Began:
    """From the map: it has begun to carry out message ``number``."""

    number: int


@dataclass(frozen=True, eq=False)
class Masks:
    """Of a keyframe: from the segmenter, and on to the map. ``segmentation_ms``: time it took."""

    keyframe_id: int
    instances: list[Instance]
    segmentation_ms: float = 0.0


@dataclass(frozen=True, eq=False)
class ImageToSegment:
    """To the segmenter: a keyframe's image (H, W, 3), and its name for those who look masks up."""

    keyframe_id: int
    rgb: Image
    name: str


@dataclass(frozen=True)
class NotSegmented:
    """From the segmenter: a keyframe's image was passed over, and why."""

    keyframe_id: int
    reason: str


@dataclass(frozen=True, eq=False)
class PruneLandmarks:
    """To the map: landmarks (N,) on things that move."""

    ids: Ints


@dataclass(frozen=True, eq=False)
class PruneMask:
    """To the map: a mask of what moves in a keyframe's image."""

    keyframe_id: int
    mask: PackedMask
    widen_px: int


@dataclass(frozen=True, eq=False)
class RestoreObservations:
    """To the map: masked keypoints (N,) of a keyframe lie on what stands after all.

    ``patches`` (N) are those of what they observed before.
    """

    keyframe_id: int
    keypoints: Ints
    patches: Patches


@dataclass(frozen=True)
class SaveState:
    """To the map: write all that is known to a file."""

    path: Path


@dataclass(frozen=True, eq=False)
class Finish:
    """To the map: no more keyframes; optimise once more and write all that is known."""

    path: Path
    history: Entries


@dataclass(frozen=True, eq=False)
class MapChanged:
    """From the map: a delta after ``keyframe_id``'s landmarks were made or the graph moved.

    ``done``: the keyframe's work is finished; ``update_ms`` is then the time it took.
    """

    keyframe_id: int
    delta: WorldDelta
    done: bool
    update_ms: float = 0.0
    loops_closed: int = 0


@dataclass(frozen=True)
class StateSaved:
    """From the map: the file holds everything up to message ``number``."""

    number: int
    path: Path


@dataclass(frozen=True)
class Ready:
    """From a worker: it has started."""

    labels: tuple[str, ...] = field(default=())
