"""Messages between the processes of the live loop: plain values that pickle."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from bmask_slam.graph.arrays import Array, Arrays, Floats, Image, Ints
from bmask_slam.graph.files.array_file import FileKind

if TYPE_CHECKING:  # a process loads what its own messages hold
    from bmask_slam.back_end.reinterpretation import KeyframeMotion
    from bmask_slam.graph.camera import Camera
    from bmask_slam.graph.inertial.tables import InertialState
    from bmask_slam.graph.sensors.streams import Measurements
    from bmask_slam.labelling.results import MapObjects
    from bmask_slam.live.replica import WorldDelta
    from bmask_slam.semantics.instances.instances import Instance, PackedMask
    from bmask_slam.tracking.results import Tracked
    from bmask_slam.world.appearance import Patches
    from bmask_slam.world.frame_history import Entries

STATE_FILE = FileKind("live state", 6)
"""What the map's process saves: its system's state, and the camera in the header."""


@dataclass(frozen=True, eq=False)
class VisibilityCounts:
    """Number of frames in whose view landmarks (N,) were, and in which they were found."""

    ids: Ints
    visible: Ints
    found: Ints


@dataclass(frozen=True, eq=False)
class NewKeyframe:
    """To the map: tracking made a frame a keyframe.

    Attributes:
        id: of the keyframe.
        frame_index, timestamp_s: of the frame.
        tracked: result of its tracking, with the image, from which patches are cut.
        segment: the map segment.
        reference: id of a keyframe and the T_world_camera that tracking knew of it, relative to
            which ``tracked.T_world_camera`` holds; None if the frame begins a segment.
        local_ids: (N,) landmarks that it was tracked against.
        reserved: first of the ids of its landmarks, and what follows the last.
        visibility: counts of the frames since the last keyframe.
        history: the frames since the last keyframe.
        depth_m: (h, w) every second pixel of its z-depth, for its masks; (0, w) if there are none.
    """

    id: int
    frame_index: int
    timestamp_s: float
    tracked: Tracked
    segment: int
    reference: tuple[int, Array] | None
    local_ids: Ints
    reserved: tuple[int, int]
    visibility: VisibilityCounts
    history: Entries
    depth_m: Floats


@dataclass(frozen=True, eq=False)
class LostKeyframe:
    """To the map, in place of a ``NewKeyframe`` that its process cannot handle.

    Attributes:
        id: of the keyframe.
        parent_id: keyframe to which its frames are attached. A keyframe that began a segment has
            none (NO_KEYFRAME): the segment begins anew.
        T_parent_lost: (4, 4) the pose of the keyframe relative to its parent.
        history: as of the ``NewKeyframe``.
        landmarks: number of landmarks ever made that tracking knows; their ids are not used again.
    """

    id: int
    parent_id: int
    T_parent_lost: Array
    history: Entries
    landmarks: int = 0


@dataclass(frozen=True)
class Started:
    """From the map or the segmenter: it handles message, or segments keyframe, ``number``."""

    number: int


@dataclass(frozen=True)
class Handled:
    """From the map: message ``number`` is handled; its answers came before."""

    number: int


@dataclass(frozen=True, eq=False)
class FramesTracked:
    """To the map: frames since the last keyframe, as in ``NewKeyframe``."""

    visibility: VisibilityCounts
    history: Entries


@dataclass(frozen=True, eq=False)
class Masks:
    """Masks of a keyframe, from the segmenter to the map; ``segmentation_ms``: time it took."""

    keyframe_id: int
    instances: list[Instance]
    segmentation_ms: float = 0.0


@dataclass(frozen=True, eq=False)
class ImageToSegment:
    """To the segmenter: a keyframe's image (H, W, 3), and its name to look masks up by."""

    keyframe_id: int
    rgb: Image
    name: str


@dataclass(frozen=True)
class NotSegmented:
    """From the segmenter: a keyframe's image was skipped, and why."""

    keyframe_id: int
    reason: str


@dataclass(frozen=True, eq=False)
class PruneLandmarks:
    """To the map: remove landmarks (N,) on moving objects."""

    ids: Ints


@dataclass(frozen=True, eq=False)
class PruneMask:
    """To the map: remove the observations under a mask of moving objects in a keyframe's image."""

    keyframe_id: int
    mask: PackedMask
    widen_px: int


@dataclass(frozen=True, eq=False)
class RestoreObservations:
    """To the map: masked keypoints (N,) of a keyframe turned out to be static; restore them.

    ``patches`` (N) are those of the landmarks that they observed before; ``reserved`` is as of
    ``NewKeyframe``.
    """

    keyframe_id: int
    keypoints: Ints
    patches: Patches
    reserved: tuple[int, int]


@dataclass(frozen=True, eq=False)
class UseCamera:
    """To the map: later keyframes are of a camera with other times; known keyframes follow it.

    ``motions`` by keyframe.
    """

    camera: Camera
    motions: dict[int, KeyframeMotion]


@dataclass(frozen=True, eq=False)
class AddMeasurements:
    """To the map: measurements of a sensor beside the camera."""

    measurements: Measurements


@dataclass(frozen=True)
class ChangeOwnFactors:
    """To the map: add a user's factors, as number and text, and remove others by number."""

    added: tuple[tuple[int, str], ...]
    removed: tuple[int, ...]


@dataclass(frozen=True)
class SaveState:
    """To the map: write its state to a file."""

    path: Path


@dataclass(frozen=True)
class Resent:
    """To the map's process: messages up to this number had been sent to another one."""

    number: int


@dataclass(frozen=True)
class TellObjects:
    """To the map: send its objects."""


@dataclass(frozen=True)
class SaveMap:
    """To the map: write the file that other runs go on from, or are localised in."""

    path: Path


@dataclass(frozen=True, eq=False)
class Finish:
    """To the map: no more keyframes; optimise a last time and write the state to a file.

    ``frames``: the state of `FrameObservations`, if frames are adjusted too.
    """

    path: Path
    history: Entries
    frames: Arrays = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class MapChanged:
    """From the map: changes, after a keyframe's landmarks were made or the graph was optimised.

    ``done``: the keyframe is finished; ``update_ms`` is then the time that it took. ``newest``: how
    the camera moved at the newest keyframe, with an IMU.
    """

    keyframe_id: int
    delta: WorldDelta
    done: bool
    update_ms: float = 0.0
    loops_closed: int = 0
    newest: InertialState | None = None


@dataclass(frozen=True)
class StateSaved:
    """From the map: the file holds the state after message ``number``."""

    number: int
    path: Path


@dataclass(frozen=True, eq=False)
class ObjectsTold:
    """From the map: the objects of its largest segment."""

    objects: MapObjects


@dataclass(frozen=True)
class MapSaved:
    """From the map: ``path`` is written; ``failure`` says why it is not."""

    path: Path
    failure: str = ""


@dataclass(frozen=True)
class EstimateCamera:
    """To the calibration: estimate from a saved state of the map."""

    state: Path


@dataclass(frozen=True, eq=False)
class CameraEstimated:
    """From the calibration: what was found.

    Attributes:
        camera: to go on with; None: with the one that there is.
        motions: of the keyframes in the map, for ``UseCamera``.
        text: one line for the log and the summary; "" if nothing can be said yet.
        done: whether no further estimate is needed.
        bent: whether the map is bent beyond repair by the camera that it was made with.
    """

    camera: Camera | None
    motions: dict[int, KeyframeMotion]
    text: str
    done: bool
    bent: bool = False


@dataclass(frozen=True)
class Ready:
    """From a worker: it can work. ``labels`` are the class names of a segmenter."""

    labels: tuple[str, ...] = field(default=())
