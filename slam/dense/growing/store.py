"""The frames of a growing surface in files: they are needed again when their poses move."""

from __future__ import annotations

import logging
import shutil
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.dense.folder import FRAMES
from bmask_slam.dense.growing.frames import SurfaceFrame
from bmask_slam.graph.arrays import Array, Arrays, Bytes, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, check_like, read_arrays, write_arrays
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.semantics.instances.image_files import decode_bytes
from bmask_slam.sequences.frame import Frame

logger = logging.getLogger(__name__)

FRAME_FILE = FileKind("surface frame", 1)
UNITS_A_M = 5000
"""Depth is stored in whole 0.2 mm up to 13.1 m: exact where a sensor's unit is 0.2 or 1 mm."""
JPEG_QUALITY, PNG_LEVEL = 95, 1
_BYTES = np.zeros(0, np.uint8)
_LIKE: Arrays = {
    "depth": _BYTES,
    "colours": _BYTES,
    "T_reference_camera": np.zeros((4, 4)),
    "follows": np.zeros(2, np.int64),
}


@dataclass(frozen=True, eq=False)
class FramePlace:
    """Where a stored frame is: see `SurfaceFrame`."""

    after: int
    reference: int
    T_reference_camera: Array


class FrameStore:
    """RUN/dense/frames: images of frames, each in one file; a full disk is no error.

    Attributes:
        places: of the frames that are there, by number.
        unwritten: how many could not be stored.
        full: why no more are stored; "" as long as they are.
    """

    def __init__(self, dense: Path, camera: Camera, max_bytes: int) -> None:
        """Know the frames that a process before this one stored; ``dense`` is RUN/dense."""
        self.places: dict[int, FramePlace] = {}
        self.unwritten, self.full = 0, ""
        self._camera, self._max_bytes, self._bytes = camera, max_bytes, 0
        self.open_in(dense)

    def open_in(self, dense: Path) -> None:
        """Go on in another RUN/dense, with the frames that are there. Raises InputError: a link."""
        self._path, self._bytes = dense / FRAMES, 0
        self.places.clear()
        refuse_link(self._path)
        with suppress(OSError):
            self._path.mkdir(exist_ok=True)
        for path in sorted(self._path.glob("[0-9]*")):
            with suppress(InputError, ValueError):
                self._know(int(path.name), _read(path), path.stat().st_size)

    def add(self, chosen: SurfaceFrame) -> bool:
        """Store a frame; whether it is stored now."""
        if chosen.number in self.places:
            return True
        path, frame = self._file(chosen.number), chosen.frame
        arrays = {
            "depth": _packed_depth(frame.depth_m),
            "colours": _packed(
                ".jpg", frame.rgb[..., ::-1], cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY
            ),
            "T_reference_camera": np.asarray(chosen.T_reference_camera, float),
            "follows": np.array([chosen.after, chosen.reference], np.int64),
        }
        size = sum(a.nbytes for a in arrays.values())
        try:
            if self._bytes + size > self._max_bytes:
                raise InputError(f"{self._path} has {self._bytes >> 20} MB, its largest size")
            write_arrays(path, FRAME_FILE, {}, arrays)
        except InputError as error:
            self._refuse(str(error))
            return False
        self.full = ""
        self._know(chosen.number, arrays, size)
        return True

    def _refuse(self, reason: str) -> None:
        self.unwritten += 1
        if not self.full:
            logger.warning("%s; the surface goes on without further frames", reason)
        self.full = reason

    def _know(self, number: int, arrays: Arrays, size: int) -> None:
        after, reference = arrays["follows"].tolist()
        self.places[number] = FramePlace(after, reference, arrays["T_reference_camera"])
        self._bytes += size

    def load(self, number: int) -> Frame:
        """The images of a stored frame. Raises InputError: they cannot be read."""
        path = self._file(number)
        arrays = _read(path)
        shape = self._camera.height, self._camera.width
        depth = decode_bytes(arrays["depth"].tobytes(), cv2.IMREAD_UNCHANGED, str(path))
        rgb = decode_bytes(arrays["colours"].tobytes(), cv2.IMREAD_COLOR_RGB, str(path))
        if depth.shape != shape or depth.dtype != np.uint16 or rgb.shape != (*shape, 3):
            raise InputError(f"{path}: is not of {shape[1]} x {shape[0]} pixels; remove it")
        depth_m = np.where(depth > 0, depth / np.float32(UNITS_A_M), np.float32(np.nan))
        return Frame(number, 0.0, np.asarray(rgb, np.uint8), np.asarray(depth_m, np.float32))

    def forget(self, number: int) -> None:
        """Remove a frame."""
        if self.places.pop(number, None) is not None:
            with suppress(OSError):
                self._file(number).unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove all of them."""
        self.places.clear()
        shutil.rmtree(self._path, ignore_errors=True)

    def _file(self, number: int) -> Path:
        return self._path / f"{number:08d}"


def _read(path: Path) -> Arrays:
    arrays = read_arrays(path, FRAME_FILE)[1]
    check_like(arrays, _LIKE, path)
    if arrays["follows"].shape != (2,) or arrays["T_reference_camera"].shape != (4, 4):
        raise InputError(f"{path}: is not the pose of one frame; remove it")
    if not np.isfinite(arrays["T_reference_camera"]).all():
        raise InputError(f"{path}: its pose is not finite; remove it")
    return arrays


def _packed_depth(depth_m: Floats) -> Bytes:
    units = np.nan_to_num(depth_m * np.float32(UNITS_A_M), nan=0.0, posinf=0.0, neginf=0.0)
    units = np.rint(units)
    units[(units < 0) | (units > np.iinfo(np.uint16).max)] = 0
    return _packed(".png", units.astype(np.uint16), cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL)


def _packed(kind: str, image: NDArray[Any], option: int, value: int) -> Bytes:
    packed = cv2.imencode(kind, np.ascontiguousarray(image), [option, value])[1]
    return np.asarray(packed, np.uint8).reshape(-1)
