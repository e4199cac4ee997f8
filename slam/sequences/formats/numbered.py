"""What layouts share: images by number, poses as matrices, cameras of another image size."""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.files.reading import read_text
from bmask_slam.graph.geometry import orthonormalised
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.sequences.lists import ImageList, sorted_list

logger = logging.getLogger(__name__)

FPS_HZ = 30.0
"""Rate of recordings that have no stamps."""
MAX_NUMBER_BYTES = 1 << 16
_TOLERANCE = 0.02
"""Of the product of a rotation with its transpose."""
CAMERA_CURE = "give --camera F"
FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])
"""From a camera with x right, y down, z forward to one with y up and z backward (OpenGL, ARKit)."""


def numbered(folder: Path, form: str) -> dict[int, Path]:
    """Files of a folder by number, increasing; the number is the group of the pattern ``form``."""
    if not folder.is_dir():
        return {}
    matches = ((re.fullmatch(form, path.name), path) for path in folder.iterdir())
    found = {int(match[1]): path for match, path in matches if match}
    return dict(sorted(found.items()))


def image_list(files: Mapping[int, Path], per_second: float, folder: Path, what: str) -> ImageList:
    """Images whose stamps are their numbers, counted so many a second.

    Raises:
        InputError: there are none.
    """
    if not files:
        raise InputError(f"{folder}: no {what} images; see the layouts in docs/data.md")
    return sorted_list(folder, np.array(list(files)) / per_second, list(files.values()))


def numbers_in(text: str, where: str) -> list[float]:
    """Numbers with spaces or commas between, also infinite ones. Raises InputError."""
    words = text.replace(",", " ").split()
    try:
        return [float(word[:40]) for word in words]
    except ValueError as error:
        raise InputError(f"{where}: {str(error)[:80]}; numbers are expected") from error


def read_matrix(path: Path) -> Array:
    """A (4, 4) matrix from a text of 16 numbers, by rows; they may be infinite.

    Raises:
        InputError: another count.
    """
    return matrix_of(read_text(path, "restore it", MAX_NUMBER_BYTES), str(path))


def matrix_of(text: str, where: str) -> Array:
    """As ``read_matrix``, from text."""
    values = numbers_in(text, where)
    if len(values) != 16:
        raise InputError(f"{where}: {len(values)} numbers where a 4x4 matrix is expected")
    return np.array(values).reshape(4, 4)


def trajectory_of(
    stamps_s: Iterable[float], poses: Iterable[Array], where: str
) -> Trajectory | None:
    """The finite poses T_world_camera (4, 4), each stamp once; None if there are none.

    Raises:
        InputError: a pose whose rotation is none.
    """
    kept: dict[float, Array] = {}
    left_out = 0
    for stamp_s, pose in zip(stamps_s, poses, strict=True):
        if stamp_s in kept or not (np.abs(pose) < 1e9).all() or not math.isfinite(stamp_s):
            left_out += 1
            continue
        R = pose[:3, :3]
        if np.abs(R @ R.T - np.eye(3)).max() > _TOLERANCE or np.linalg.det(R) < 0:
            raise InputError(f"{where}: the pose at {stamp_s:.6f} s is no rotation; remove it")
        kept[stamp_s] = orthonormalised(pose)
    if left_out:
        logger.warning("%s: %d poses that are not finite, or repeated, left out", where, left_out)
    return Trajectory(np.array(list(kept)), np.array(list(kept.values()))) if kept else None


def camera_of_matrix(K: Array, size: tuple[int, int], depth_scale: float, where: str) -> Camera:
    """The camera of a calibration matrix (3, 3) and a size (width, height). Raises InputError."""
    fx, fy, cx, cy = (float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    with naming(where, CAMERA_CURE):
        return Camera(*size, fx, fy, cx, cy, depth_scale=depth_scale)
