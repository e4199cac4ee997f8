"""The saved map of a run, and the sequence that it was made from: the input of dense mapping."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from bmask_slam.evaluation.recordings import JOINED
from bmask_slam.graph.arrays import Array, Arrays, Ints, Mask
from bmask_slam.graph.camera import Camera, direction_of
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import GRAVITY, reference_frame_id
from bmask_slam.graph.files.array_file import fitting, part
from bmask_slam.mapping.inverse_depth.dense_mapper import DepthSource
from bmask_slam.run_folder.map_file import MAP, RunLabels, read_map, saved_labels
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.objects.gravity import most_common, sides_of
from bmask_slam.sequences.right_images import RIGHT_LIST, RightImages, read_right_images
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.map_state import world_of
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_LENGTH_ERROR = 1e-3
NO_INFORMATION = {"information": np.zeros((0, 6, 6))}
"""What the frames of files of older versions lack, which is not needed here."""


@dataclass(frozen=True, eq=False)
class SavedMap:
    """The map of a run folder.

    Attributes:
        path: the run folder.
        world: the map.
        keyframes: those of the segment of trajectory.txt that its recording shows, oldest first.
        camera: of the images, with distortion.
        labels: the classes of its landmarks; None if the run had no segmenter.
        sides: the side of keyframes' images that is up, of `graph.camera.SIDES`, by keyframe id; ""
            where that is not known.
        up_world: (3,) unit vector of these keyframes, by an accelerometer or an IMU in the graph;
            None without.
        foreign: number of the segment's other keyframes, of recordings that the run continued.
    """

    path: Path
    world: WorldMap
    keyframes: list[Keyframe]
    camera: Camera
    labels: RunLabels | None = None
    sides: dict[int, str] = field(default_factory=dict)
    up_world: Array | None = None
    foreign: int = 0

    def poses(self) -> dict[int, Array]:
        """The current T_world_camera (4, 4) of every keyframe by its id."""
        return {k.id: k.T_world_camera for k in self.world.keyframes.values()}

    @property
    def side(self) -> str:
        """The side of most images that is up; "" if that is not known."""
        return most_common(self.sides.values()) or self.camera.up

    def up_guess(self) -> Array:
        """About up (3,), a unit vector: by gravity, or the mean direction of the upper side."""
        if self.up_world is not None:
            return self.up_world
        ups = [
            k.T_world_camera[:3, :3] @ direction_of(self.sides.get(k.id) or self.side)
            for k in self.keyframes
        ]
        up = np.nanmean(ups, axis=0)
        return np.asarray(up / np.linalg.norm(up), float)

    def label_distributions(self, ids: Ints, names: LabelSet) -> tuple[Array, Mask]:
        """Distributions (N, C) over ``names`` of landmarks (N,), and which (N,) are known.

        None is known where the run had other labels.
        """
        if self.labels is None or self.labels.names != names or not len(ids):
            return np.zeros((len(ids), len(names))), np.zeros(len(ids), bool)
        parents = self.world.landmarks.current(ids)
        store = self.labels.store
        return store.probabilities(parents), store.estimates(parents).views > 0


@dataclass(frozen=True, eq=False, kw_only=True)
class MappedRun(SavedMap):
    """A run folder and its sequence.

    Attributes:
        sequence: the images.
        right: the right images, if depth comes from stereo pairs.
    """

    sequence: Sequence
    right: RightImages | None = None


def open_run(path: Path, sequence: Path | None = None) -> MappedRun:
    """Open a finished run; ``sequence`` is needed if the images have moved.

    Raises:
        InputError: no map in the folder, no keyframe of its recording, or no sequence.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give the folder of a finished run")
    saved = read_saved_map(path)
    if saved.foreign:
        of_others = f"{saved.foreign} keyframes are of recordings that it continued"
        if not saved.keyframes:
            raise InputError(f"{path}: all {of_others}; give the runs of these")
        logger.warning("%s: %s, and left out; map the runs of these", path, of_others)
    folder = sequence or find_sequence(path)
    opened = open_sequence(folder, camera=saved.camera)
    return MappedRun(**vars(saved), sequence=opened)


def with_right_images(run: MappedRun, source: DepthSource) -> MappedRun:
    """The run with its right images and the bf of the pairs, if the source of depth uses them.

    Raises:
        InputError: the source is "stereo" and the right images or the baseline are not there.
    """
    optional = source == "both" and (run.sequence.folder / RIGHT_LIST).is_file()
    if source != "stereo" and not optional:
        return run
    right = read_right_images(run.sequence, run.camera)
    return replace(run, camera=right.camera, right=right)


def read_saved_map(path: Path) -> SavedMap:
    """The map of a run folder, without its images. Raises InputError if there is none."""
    state, camera = read_map(path)
    with fitting(path / MAP):
        world, history = world_of(part(state, "mapper.world")), FrameHistory()
        if frames := part(state, "mapper.history"):
            history.restore(NO_INFORMATION | frames)
        segment = history.largest_segment(world)
        labels = saved_labels(part(state, "semantics"), path)
        up_world = _measured_up(part(state, "mapper.graph"), segment)
        sides = _sides(part(state, "semantics.upright"))
        first = int(state.get("first_keyframe", 0))
    keyframes = world.in_segment(segment)
    if (path / JOINED).is_file():
        own = [k for k in keyframes if np.isfinite(k.timestamp_s)]
    else:
        own = [k for k in keyframes if k.id >= first]
    foreign = len(keyframes) - len(own)
    return SavedMap(path, world, own, camera, labels, sides, up_world, foreign)


def _sides(upright: Arrays) -> dict[int, str]:
    """The side of the images that is up by keyframe id; none of older files."""
    if "sides" not in upright:
        return {}
    return dict(zip(upright["keyframes"].tolist(), sides_of(upright["sides"]), strict=True))


def _measured_up(graph: Arrays, segment: int) -> Array | None:
    """The z axis (3,) of a segment's reference frame, if gravity was measured in it."""
    if not graph:
        return None
    frame = reference_frame_id(segment)
    of_frame = graph["pose_factor_keyframes"][:, 0] == frame
    if not (of_frame & (graph["pose_factor_kinds"] == GRAVITY)).any():
        return None
    up = graph["poses_world_camera"][graph["keyframe_ids"] == frame][0, :3, 2]
    if not abs(np.linalg.norm(up) - 1) < MAX_LENGTH_ERROR:
        raise ValueError(f"up is {up}, which is no direction")
    return np.asarray(up, float)
