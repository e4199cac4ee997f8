"""Recordings of iPhones and iPads with LiDAR: Record3D's .r3d files and Polycam's raw data.

Both are of ARKit: cameras have y up and z backward, the world has y up, depth is registered to
colour but coarser.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.files.json_file import STRICT, parse_json, read_json
from bmask_slam.graph.geometry import make_pose, rotation_from_quaternion
from bmask_slam.semantics.instances.image_files import decode_colour, decode_image
from bmask_slam.sequences.cameras import recorded_camera
from bmask_slam.sequences.formats.lzfse import unpack_lzfse
from bmask_slam.sequences.formats.numbered import (
    CAMERA_CURE,
    FLIP_YZ,
    FPS_HZ,
    camera_of_matrix,
    image_list,
    numbered,
    trajectory_of,
)
from bmask_slam.sequences.lists import sorted_list
from bmask_slam.sequences.recording import DepthForm, Recording

Given = Path | Camera | None
Side = Annotated[int, Field(gt=0, lt=1 << 14)]
_CURE = "export it again"
_MAX_MEMBER = 1 << 26
_PER_SECOND = 1e6
"""Polycam's names are times in microseconds."""


@dataclass(frozen=True)
class _R3dMetadata:
    __pydantic_config__ = STRICT
    w: Side
    h: Side
    K: Annotated[list[float], Field(min_length=9, max_length=9)]
    dw: Side = 192
    dh: Side = 256
    fps: Annotated[float, Field(gt=0, le=1000)] = FPS_HZ
    poses: list[Annotated[list[float], Field(min_length=7, max_length=7)]] = ()  # type: ignore[assignment]
    frameTimestamps: list[float] = ()  # type: ignore[assignment]


def is_r3d(path: Path) -> bool:
    """Whether the name is that of a .r3d file."""
    return path.suffix == ".r3d"


def open_r3d(path: Path, given: Given) -> Recording:
    """A zip of rgbd/N.jpg, rgbd/N.depth (LZFSE of float32 metres) and their metadata.

    Raises:
        InputError: no such zip, or broken metadata.
    """
    images = _R3dImages(path)
    said = parse_json(images.member("metadata"), _R3dMetadata, f"{path}: metadata", _CURE)
    images.depth_size = said.dw, said.dh
    count = sum(1 for name in images.names if name.startswith("rgbd/") and name.endswith(".jpg"))
    stamps_s = np.arange(count) / said.fps
    if len(said.frameTimestamps) >= count:
        stamps_s = np.array(said.frameTimestamps[:count])
    K = np.array(said.K).reshape(3, 3).T
    own = camera_of_matrix(K, (said.w, said.h), 1.0, str(path))
    camera, source = recorded_camera(own, str(path), path.parent, given)
    files = {
        kind: [path / "rgbd" / f"{k}.{kind}" for k in range(count)] for kind in ("jpg", "depth")
    }
    if not count:
        raise InputError(f"{path}: no rgbd/0.jpg; {_CURE}")
    poses = [_arkit_pose(row, str(path)) for row in said.poses[:count]]
    return Recording(
        "Record3D", path, sorted_list(path, stamps_s, files["jpg"]),
        sorted_list(path, stamps_s, files["depth"]), camera, source,
        trajectory_of(stamps_s[: len(poses)], poses, str(path)),
        DepthForm(camera=own.of_size(said.dw, said.dh)),
        images.colour, images.depth, images.exists,
    )  # fmt: skip


def _arkit_pose(row: list[float], where: str) -> Array:
    """T_world_camera, x right, y down, of a row qx qy qz qw tx ty tz of ARKit's camera."""
    q = np.array(row[:4])
    if not 0.5 < np.linalg.norm(q) < 2:
        raise InputError(f"{where}: {q.tolist()} is no rotation; {_CURE}")
    return make_pose(rotation_from_quaternion(q), np.array(row[4:])) @ FLIP_YZ


class _R3dImages:
    """Members of a .r3d file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.depth_size = (0, 0)
        try:
            with zipfile.ZipFile(path) as packed:
                self.names = frozenset(packed.namelist())
        except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError) as error:
            raise InputError(
                f"{path}: cannot be read as a zip ({str(error)[:80]}); {_CURE}"
            ) from error

    def exists(self, file: Path) -> bool:
        """Whether it holds an image."""
        return f"rgbd/{file.name}" in self.names

    def member(self, name: str) -> bytes:
        """The content of a member. Raises InputError."""
        try:
            with zipfile.ZipFile(self._path) as packed:
                if packed.getinfo(name).file_size > _MAX_MEMBER:
                    raise InputError(f"{self._path}: {name} has over {_MAX_MEMBER} bytes; {_CURE}")
                with packed.open(name) as file:
                    return file.read(_MAX_MEMBER)
        except KeyError as error:
            raise InputError(f"{self._path}: no {name} in it; {_CURE}") from error
        except (OSError, zipfile.BadZipFile, zipfile.LargeZipFile, EOFError, ValueError,
                RuntimeError, NotImplementedError, zlib.error) as error:  # fmt: skip
            raise InputError(f"{self._path}: {name} is broken ({str(error)[:80]})") from error

    def colour(self, file: Path) -> Image:
        """A colour image (H, W, 3), red first. Raises InputError."""
        return decode_colour(self.member(f"rgbd/{file.name}"), str(file))

    def depth(self, file: Path) -> NDArray:
        """Depth (h, w) in metres, float32, 0 or NaN where missing. Raises InputError."""
        width, height = self.depth_size
        data = unpack_lzfse(self.member(f"rgbd/{file.name}"), 4 * width * height, str(file))
        return np.frombuffer(data, "<f4").reshape(height, width).astype(np.float32)


@dataclass(frozen=True)
class _PolycamCamera:
    __pydantic_config__ = STRICT
    width: Side
    height: Side
    fx: float
    fy: float
    cx: float
    cy: float
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float

    @property
    def T_world_camera(self) -> Array:
        rows = [[getattr(self, f"t_{i}{j}") for j in range(4)] for i in range(3)]
        return np.array([*rows, [0, 0, 0, 1.0]]) @ FLIP_YZ


def _polycam_parts(folder: Path) -> tuple[Path, Path, Path]:
    """Colour, camera and depth folders; the corrected ones where they are."""
    root = folder / "keyframes" if (folder / "keyframes").is_dir() else folder
    corrected = (root / "corrected_cameras").is_dir() and (root / "corrected_images").is_dir()
    before = "corrected_" if corrected else ""
    return root / f"{before}images", root / f"{before}cameras", root / "depth"


def is_polycam(folder: Path) -> bool:
    """Whether it is raw data as Polycam exports them."""
    return all(part.is_dir() for part in _polycam_parts(folder))


def open_polycam(folder: Path, given: Given) -> Recording:
    """Keyframes, a few a second; the camera is that of the median focal length of all frames.

    Raises:
        InputError: broken cameras, or no images.
    """
    images, cameras, depths = _polycam_parts(folder)
    said = {
        number: read_json(path, _PolycamCamera, _CURE)
        for number, path in numbered(cameras, r"(\d{1,18})\.json").items()
    }
    if not said:
        raise InputError(f"{cameras}: no cameras; {_CURE}")
    middle = sorted(said.values(), key=lambda camera: camera.fx)[len(said) // 2]
    size, centre = (middle.width, middle.height), (middle.cx, middle.cy)
    with naming(str(cameras), CAMERA_CURE):
        own = Camera(*size, middle.fx, middle.fy, *centre, depth_scale=1000.0)
    camera, source = recorded_camera(own, str(cameras), folder, given)
    poses = [one.T_world_camera for one in said.values()]
    depth = numbered(depths, r"(\d{1,18})\.png")
    lists = [
        image_list(files, _PER_SECOND, folder, what)
        for files, what in ((numbered(images, r"(\d{1,18})\.jpg"), "colour"), (depth, "depth"))
    ]
    stored = decode_image(next(iter(depth.values())), cv2.IMREAD_UNCHANGED)
    truth = trajectory_of([number / _PER_SECOND for number in said], poses, str(cameras))
    form = DepthForm(camera=own.of_size(stored.shape[1], stored.shape[0]))
    return Recording("Polycam", folder, lists[0], lists[1], camera, source, truth, form)
