"""ScanNet's .sens files: all images of a scene in one file, version 4 of its SensorData."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse
from bmask_slam.semantics.instances.image_files import decode_colour
from bmask_slam.sequences.cameras import recorded_camera
from bmask_slam.sequences.formats.numbered import FPS_HZ, camera_of_matrix, trajectory_of
from bmask_slam.sequences.lists import sorted_list
from bmask_slam.sequences.recording import DepthForm, Recording

VERSION = 4
MICROSECONDS = 1e-6
COLOUR_KINDS = {1: "PNG", 2: "JPEG"}
RAW_DEPTH, ZLIB_DEPTH = 0, 1
_SIZES = struct.Struct("<2i4IfQ")
_FRAME = struct.Struct("<16f4Q")
_MATRICES = struct.Struct("<64f")
_MAX_IMAGE_BYTES = 1 << 26
_CURE = "restore it, or export its frames with ScanNet's SensReader"


def is_sens(path: Path) -> bool:
    """Whether the name is that of a .sens file."""
    return path.suffix == ".sens"


@dataclass(frozen=True)
class _Frame:
    """Where the data of a frame are in the file: begin and length in bytes."""

    colour: tuple[int, int]
    depth: tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Header:
    """Of a file: the cameras, sizes and kinds of compression."""

    matrices: Array
    kinds: tuple[int, int]
    colour_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float
    frames: int


def open_sens(path: Path, given: Path | Camera | None) -> Recording:
    """Depth is coarser than colour and is registered; stamps of 0 count as 30 Hz.

    Raises:
        InputError: another version or compression, or a file that is cut off.
    """
    with _opened(path) as file:
        header = _read_header(file, path)
        frames, poses, ticks = _read_index(file, path, header)
    stamps_s = ticks * MICROSECONDS
    for kind in range(2):
        if not stamps_s[:, kind].any():
            stamps_s[:, kind] = np.arange(len(frames)) / FPS_HZ
    names = [f"{k:06d}" for k in range(len(frames))]
    places = {path / kind / n: f for n, f in zip(names, frames, strict=True) for kind in "cd"}
    lists = [sorted_list(path, stamps_s[:, k], [path / "cd"[k] / n for n in names]) for k in (0, 1)]
    colour, _, depth, _ = header.matrices
    own = camera_of_matrix(colour, header.colour_size, header.depth_scale, str(path))
    depth_camera = camera_of_matrix(depth, header.depth_size, header.depth_scale, str(path))
    camera, source = recorded_camera(own, str(path), path.parent, given)
    extrinsics = [m for m in header.matrices[1::2] if trajectory_of([0.0], [m], str(path))]
    T = np.eye(4) if len(extrinsics) < 2 else inverse(extrinsics[0]) @ extrinsics[1]
    images = _SensImages(path, places, header)
    return Recording(
        "ScanNet .sens", path, lists[0], lists[1], camera, source,
        trajectory_of(stamps_s[:, 0], poses, str(path)), DepthForm(0, depth_camera, T),
        images.colour, images.depth, places.__contains__,
    )  # fmt: skip


@contextmanager
def _opened(path: Path) -> Iterator[IO[bytes]]:
    """The file, to be read in the block. Raises InputError if it cannot be."""
    try:
        with open(path, "rb") as file:
            yield file
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from error


def _read_header(file: IO[bytes], path: Path) -> _Header:
    version, name_bytes = struct.unpack("<IQ", _exactly(file, 12, path))
    if version != VERSION or name_bytes > 4096:
        raise InputError(f"{path}: version {version} of .sens, {VERSION} is expected; {_CURE}")
    _exactly(file, name_bytes, path)
    matrices = np.array(_MATRICES.unpack(_exactly(file, _MATRICES.size, path)), float)
    values = _SIZES.unpack(_exactly(file, _SIZES.size, path))
    colour, depth = values[0], values[1]
    if colour not in COLOUR_KINDS or depth not in (RAW_DEPTH, ZLIB_DEPTH):
        raise InputError(f"{path}: images of compression {colour} and {depth} are unknown; {_CURE}")
    if not 1 <= values[6] <= 1e6 or max(values[2:6]) > 1 << 14 or not min(values[2:6]):
        raise InputError(f"{path}: images of {values[2:6]} pixels, {values[6]:g} to the metre")
    sizes = (values[2], values[3]), (values[4], values[5])
    return _Header(matrices.reshape(4, 4, 4), (colour, depth), *sizes, values[6], values[7])


def _read_index(
    file: IO[bytes], path: Path, header: _Header
) -> tuple[list[_Frame], list[Array], Array]:
    """Places, poses T_world_camera and stamps (N, 2) of colour and depth in microseconds."""
    end = os.fstat(file.fileno()).st_size
    frames: list[_Frame] = []
    poses: list[Array] = []
    ticks: list[tuple[int, int]] = []
    if header.frames * _FRAME.size > end:
        raise InputError(f"{path}: {header.frames} frames do not fit into {end} bytes; {_CURE}")
    for _ in range(header.frames):
        *pose, colour_us, depth_us, colour_bytes, depth_bytes = _FRAME.unpack(
            _exactly(file, _FRAME.size, path)
        )
        begin = file.tell()
        if max(colour_bytes, depth_bytes) > _MAX_IMAGE_BYTES:
            raise InputError(f"{path}: an image of {max(colour_bytes, depth_bytes)} bytes; {_CURE}")
        if begin + colour_bytes + depth_bytes > end:
            raise InputError(f"{path}: cut off at frame {len(frames)}; {_CURE}")
        frames.append(_Frame((begin, colour_bytes), (begin + colour_bytes, depth_bytes)))
        poses.append(np.array(pose).reshape(4, 4))
        ticks.append((colour_us, depth_us))
        file.seek(begin + colour_bytes + depth_bytes)
    if not frames:
        raise InputError(f"{path}: no frames; {_CURE}")
    return frames, poses, np.array(ticks, float)


def _exactly(file: IO[bytes], size: int, path: Path) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise InputError(f"{path}: cut off after {file.tell()} bytes; {_CURE}")
    return data


class _SensImages:
    """Decodes the images of a file."""

    def __init__(self, path: Path, places: dict[Path, _Frame], header: _Header) -> None:
        self._path, self._places, self._header = path, places, header

    def colour(self, file: Path) -> Image:
        """A colour image (H, W, 3), red first. Raises InputError."""
        return decode_colour(self._bytes(*self._places[file].colour), str(file))

    def depth(self, file: Path) -> NDArray:
        """Stored depth (h, w), uint16. Raises InputError."""
        data, (width, height) = self._bytes(*self._places[file].depth), self._header.depth_size
        expected = 2 * width * height
        if self._header.kinds[1] == ZLIB_DEPTH:
            try:
                data = zlib.decompressobj().decompress(data, expected + 1)
            except zlib.error as error:
                raise InputError(f"{file}: depth cannot be unpacked ({error}); {_CURE}") from error
        if len(data) != expected:
            raise InputError(f"{file}: {len(data)} bytes of depth for {width}x{height}; {_CURE}")
        return np.frombuffer(data, "<u2").reshape(height, width).astype(np.uint16)

    def _bytes(self, begin: int, size: int) -> bytes:
        with _opened(self._path) as file:
            file.seek(begin)
            return _exactly(file, size, self._path)
