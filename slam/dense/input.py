"""A finished run as input of dense mapping: its keyframes with their images, checked."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.dense.keyframe_view import SeenKeyframe, seen
from bmask_slam.graph.arrays import Array, Floats, Image, Ints, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import part
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, DepthSource
from bmask_slam.run_folder.map_file import RunLabels, read_map, saved_labels
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.sequences import Sequence, open_sequence
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.right_images import RightImages
from bmask_slam.world.map_state import world_of
from bmask_slam.world.world_map import Keyframe, WorldMap

logger = logging.getLogger(__name__)

MAX_STAMP_ERROR_S = 1e-4
MIN_DEPTH_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class SavedMap:
    """The map of a run folder.

    Attributes:
        path: the run folder.
        world: its map.
        keyframes: those of its largest segment, oldest first.
        camera: whose distortion is taken out of what ``load`` returns.
        labels: what it knows of its landmarks' classes; None if it had no segmenter.
    """

    path: Path
    world: WorldMap
    keyframes: list[Keyframe]
    camera: Camera
    labels: RunLabels | None = None

    def poses(self) -> dict[int, Array]:
        """T_world_camera of every keyframe by its id, as it is at this moment."""
        return {k.id: k.T_world_camera for k in self.world.keyframes.values()}

    def believed(self, ids: Ints, names: LabelSet) -> tuple[Array, Mask]:
        """Distributions (N, C) over ``names`` of landmarks (N,), and which are known."""
        nothing = np.zeros((len(ids), len(names))), np.zeros(len(ids), bool)
        if self.labels is None or self.labels.names != names or not len(ids):
            return nothing
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
    """Open a finished run; the sequence is that of the run unless it has moved.

    Raises:
        InputError: no map in the folder, or no sequence.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such folder; give the folder of a finished run")
    saved = read_saved_map(path)
    folder = sequence or find_sequence(path)
    opened = open_sequence(folder, camera=saved.camera)
    return MappedRun(**vars(saved), sequence=opened)


def read_saved_map(path: Path) -> SavedMap:
    """The map of a run folder, without its images. Raises InputError if there is none."""
    state, camera = read_map(path)
    world = world_of(part(state, "mapper.world"))
    keyframes = world.in_segment(world.largest_segment())
    labels = saved_labels(part(state, "semantics"), path)
    return SavedMap(path, world, keyframes, camera, labels)


def load(
    run: MappedRun, keyframe: Keyframe, source: DepthSource = "sensor"
) -> tuple[DenseKeyframe, SeenKeyframe]:
    """A keyframe with its images, undistorted, and what it was made of.

    Raises:
        InputError: a pose that is not finite, no landmarks, an image that cannot be read or is
            not the keyframe's, or none of what the source of depth needs: this keyframe cannot be
            mapped.
    """
    whole = seen(run.world, keyframe, run.sequence.load(frame_index(run, keyframe)))
    dense = dense_keyframe(whole, run.camera, source)
    return replace(dense, right=_right(run, keyframe, source)), whole


def dense_keyframe(
    whole: SeenKeyframe, camera: Camera, source: DepthSource = "sensor"
) -> DenseKeyframe:
    """A keyframe with undistorted images. Raises InputError if it cannot be mapped, as ``load``."""
    name = f"keyframe {whole.id}"
    if not np.isfinite(whole.T_world_camera).all():
        raise InputError(f"{name}: its pose is not finite; run the sequence again")
    if len(whole.landmark_ids) == 0:
        raise InputError(f"{name}: it observes no landmark, so its place is not known")
    if source in ("sensor", "both") and np.isfinite(whole.frame.depth_m).mean() < MIN_DEPTH_SHARE:
        raise InputError(f"{name}: frame {whole.frame.index} has no valid depth")
    rgb, depth_m = undistorted(whole.frame, camera)
    depths_m = transform(inverse(whole.T_world_camera), whole.points_world)[:, 2]
    return DenseKeyframe(whole.id, whole.T_world_camera, rgb, depth_m, whole.landmark_ids, depths_m)


def frame_index(run: MappedRun, keyframe: Keyframe) -> int:
    """Where in the sequence a keyframe's images are, by its stamp.

    A live run counts the frames that it tracked, not those of the sequence.

    Raises:
        InputError: the sequence has no such frame.
    """
    stamps_s, index = run.sequence.timestamps_s, keyframe.frame_index
    nearest = int(np.abs(stamps_s - keyframe.timestamp_s).argmin())
    if abs(stamps_s[nearest] - keyframe.timestamp_s) <= MAX_STAMP_ERROR_S:
        return nearest
    if not 0 <= index < len(run.sequence):
        raise InputError(f"keyframe {keyframe.id}: frame {index} is not in {run.sequence.folder}")
    raise InputError(
        f"keyframe {keyframe.id}: frame {index} of {run.sequence.folder} is of "
        f"{stamps_s[index]:.6f} s, not {keyframe.timestamp_s:.6f} s; give its own --sequence"
    )


def _right(run: MappedRun, keyframe: Keyframe, source: DepthSource) -> Image | None:
    """The keyframe's right image; only where it is the one source of depth it cannot be missed."""
    if run.right is None or source == "motion":
        return None
    try:
        return run.right.load(frame_index(run, keyframe))
    except InputError as error:
        if source == "stereo":
            raise InputError(f"keyframe {keyframe.id}: {error}") from error
        logger.warning("keyframe %d: %s; it is swept instead", keyframe.id, error)
        return None


def image_name(run: MappedRun, keyframe: Keyframe) -> str:
    """The name of a keyframe's colour image relative to its sequence."""
    folder = run.sequence.folder
    file = run.sequence.pairs.rgb_files[frame_index(run, keyframe)]
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.name


def undistorted(frame: Frame, camera: Camera) -> tuple[Image, Floats]:
    """Colour and depth of a frame as a camera without distortion sees them."""
    if not any(camera.distortion):
        return frame.rgb, frame.depth_m
    maps = undistortion_maps(camera)
    rgb = cv2.remap(frame.rgb, *maps, cv2.INTER_LINEAR)
    outside = float("nan")
    depth_m = cv2.remap(frame.depth_m, *maps, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, outside)
    return rgb, depth_m


def undistorted_labels(numbers: NDArray[np.uint16], camera: Camera) -> NDArray[np.uint16]:
    """Numbers (H, W) of pixels as a camera without distortion sees them, 0 outside."""
    if not any(camera.distortion):
        return numbers
    return np.asarray(cv2.remap(numbers, *undistortion_maps(camera), cv2.INTER_NEAREST))


def undistortion_maps(camera: Camera) -> tuple[Floats, Floats]:
    """Where each pixel (H, W) of the undistorted image lies in the distorted one."""
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    x, y = np.moveaxis(camera.distort(np.stack([columns, rows], axis=-1)), -1, 0)
    return x.astype(np.float32), y.astype(np.float32)
