"""One keyframe as input of dense mapping: its undistorted images and its landmarks, checked."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.dense.saved_map import MappedRun
from bmask_slam.graph.arrays import Array, Floats, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseKeyframe, DepthSource
from bmask_slam.sequences.frame import Frame
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

logger = logging.getLogger(__name__)

MAX_STAMP_ERROR_S = 1e-4
MIN_DEPTH_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class KeyframeSnapshot:
    """A keyframe as it is in the map at one moment, with its images.

    Attributes:
        id: of the keyframe. segment: map segment.
        T_world_camera: (4, 4).
        frame: the images as they were taken, distorted.
        landmark_ids: (L,) landmarks that it observes. points_world: (L, 3) their positions.
        pixels: (L, 2) where they were detected in the distorted image.
    """

    id: int
    segment: int
    T_world_camera: Array
    frame: Frame
    landmark_ids: Ints
    points_world: Array
    pixels: Array

    @classmethod
    def of(cls, world: WorldMap, keyframe: Keyframe, frame: Frame) -> KeyframeSnapshot:
        """The keyframe as it is in the map now."""
        rows, ids = world.observed(keyframe)
        return cls(
            keyframe.id,
            keyframe.segment,
            keyframe.T_world_camera,
            frame,
            ids,
            world.landmarks.points_world[ids],
            keyframe.features.image_pixels[rows],
        )


def load_keyframe(
    run: MappedRun, keyframe: Keyframe, source: DepthSource = "sensor"
) -> tuple[DenseKeyframe, KeyframeSnapshot]:
    """A keyframe with undistorted images, and the snapshot that it was made from.

    Raises:
        InputError: this keyframe cannot be mapped: its pose is not finite, it observes no
            landmark, its image cannot be read or has another stamp, or the source of depth has
            nothing.
    """
    frame = run.sequence.load(frame_index(run, keyframe))
    snapshot = KeyframeSnapshot.of(run.world, keyframe, frame)
    dense = dense_keyframe(snapshot, run.camera, source)
    return replace(dense, right=_right_image(run, keyframe, source)), snapshot


def dense_keyframe(
    snapshot: KeyframeSnapshot, camera: Camera, source: DepthSource = "sensor"
) -> DenseKeyframe:
    """A keyframe with undistorted images. Raises InputError as ``load_keyframe``."""
    name, frame = f"keyframe {snapshot.id}", snapshot.frame
    if not np.isfinite(snapshot.T_world_camera).all():
        raise InputError(f"{name}: its pose is not finite; run the sequence again")
    if len(snapshot.landmark_ids) == 0:
        raise InputError(f"{name}: it observes no landmark, so its place is not known")
    if source in ("sensor", "both") and np.isfinite(frame.depth_m).mean() < MIN_DEPTH_SHARE:
        raise InputError(f"{name}: frame {frame.index} has no valid depth")
    T_world_camera, ids = snapshot.T_world_camera, snapshot.landmark_ids
    rgb, depth_m = undistort_images(frame, camera)
    depths_m = transform(inverse(T_world_camera), snapshot.points_world)[:, 2]
    return DenseKeyframe(snapshot.id, T_world_camera, rgb, depth_m, ids, depths_m)


def frame_index(run: MappedRun, keyframe: Keyframe) -> int:
    """Index in the sequence of a keyframe's images, by its stamp.

    The keyframe's own index does not serve: a live run counts the frames that it tracked, not
    those of the sequence.

    Raises:
        InputError: the sequence has no frame with this stamp.
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


def image_name(run: MappedRun, keyframe: Keyframe) -> str:
    """The name of a keyframe's colour image relative to its sequence."""
    folder = run.sequence.folder
    file = run.sequence.pairs.rgb_files[frame_index(run, keyframe)]
    return file.relative_to(folder).as_posix() if file.is_relative_to(folder) else file.name


def _right_image(run: MappedRun, keyframe: Keyframe, source: DepthSource) -> Image | None:
    """The keyframe's right image; None where there is none and another source of depth."""
    if run.right is None or source == "motion":
        return None
    try:
        return run.right.load(frame_index(run, keyframe))
    except InputError as error:
        if source == "stereo":
            raise InputError(f"keyframe {keyframe.id}: {error}") from error
        logger.warning("keyframe %d: %s; a plane sweep is used instead", keyframe.id, error)
        return None


def undistort_images(frame: Frame, camera: Camera) -> tuple[Image, Floats]:
    """Colour (H, W, 3) and depth (H, W) of a frame as a camera without distortion records them."""
    if not any(camera.distortion):
        return frame.rgb, frame.depth_m
    maps = _undistortion_maps(camera)
    rgb = cv2.remap(frame.rgb, *maps, cv2.INTER_LINEAR)
    nan = float("nan")
    depth_m = cv2.remap(frame.depth_m, *maps, cv2.INTER_NEAREST, None, cv2.BORDER_CONSTANT, nan)
    return np.asarray(rgb, np.uint8), np.asarray(depth_m, np.float32)


def undistort_labels(numbers: NDArray[np.uint16], camera: Camera) -> NDArray[np.uint16]:
    """Numbers (H, W) of pixels in the undistorted image, 0 where the camera did not record it."""
    if not any(camera.distortion):
        return numbers
    return np.asarray(cv2.remap(numbers, *_undistortion_maps(camera), cv2.INTER_NEAREST))


def _undistortion_maps(camera: Camera) -> tuple[Floats, Floats]:
    """Columns and rows (H, W) in the distorted image of each pixel of the undistorted one."""
    pixels = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    columns, rows = np.moveaxis(camera.distort(pixels.astype(float)), -1, 0)
    return columns.astype(np.float32), rows.astype(np.float32)
