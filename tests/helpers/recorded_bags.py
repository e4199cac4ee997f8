"""Small ROS bags and their contents; the pixels give the frame number."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.geometry import quaternion_from_rotation, se3_exp
from bmask_slam.sequences.frame import Frame

STEP_S = 1 / 30
BEGIN_S = 1305031102.0
RGB, DEPTH, INFO = "/camera/rgb/image_color", "/camera/depth/image", "/camera/rgb/camera_info"
SMALL = SimpleNamespace(width=160, height=120, fx=131.25, fy=130.0, cx=79.625, cy=60.375)
"""The camera of ``synthetic_view`` where every fourth pixel is kept."""
ONE_FILE = (".mcap", ".db3")
"""Of ROS 2."""
TYPES = {True: get_typestore(Stores.ROS1_NOETIC), False: get_typestore(Stores.ROS2_HUMBLE)}
assert SMALL.fx * 4 == CAMERA.fx


@cache
def view(index: int) -> Frame:
    """A moving camera before a plane; colours that differ, a hole in the depth."""
    full = render_plane(se3_exp(np.array([0, 0.003, 0, 0.01, 0, 0]) * index), index)
    rgb = full.rgb[::4, ::4] // np.array([1, 2, 3], np.uint8)
    rgb[:8, :8] = (250, 10 * index, 0)
    depth_m = full.depth_m[::4, ::4].copy()
    depth_m[:4, :6] = np.nan
    return Frame(index, BEGIN_S + index * STEP_S, rgb, depth_m)


def image(encoding: str, pixels: np.ndarray, padding: int = 0, big_endian: bool = False) -> Any:
    """A stand-in for sensor_msgs/Image; rows may be padded with noise."""
    height, width = pixels.shape[:2]
    swapped = pixels.astype(pixels.dtype.newbyteorder(">" if big_endian else "<"))
    rows = np.frombuffer(swapped.tobytes(), np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=171)
    return SimpleNamespace(
        encoding=encoding, height=height, width=width, step=rows.shape[1],
        is_bigendian=int(big_endian), data=rows.ravel(),
    )  # fmt: skip


def compressed(form: str, suffix: str, pixels: np.ndarray, head: bytes = b"") -> Any:
    """A stand-in for sensor_msgs/CompressedImage; colours as OpenCV wants them, blue first."""
    data = head + cv2.imencode(suffix, pixels)[1].tobytes()
    return SimpleNamespace(format=form, data=np.frombuffer(data, np.uint8))


def camera_info(distortion: tuple[float, ...] = (0.1, -0.2, 0.001, 0.002, 0.05)) -> Any:
    """A stand-in for sensor_msgs/CameraInfo; the rectified camera has its own focal length."""
    c = SMALL
    k = np.array([c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1.0])
    p = np.array([100.0, 0, 80.0, 0, 0, 100.0, 60.0, 0, 0, 0, 1.0, 0])
    return SimpleNamespace(
        width=c.width, height=c.height, k=k, p=p, d=np.array(distortion),
        distortion_model="plumb_bob",
    )  # fmt: skip


class BagMaker:
    """Writes a bag: .bag is ROS 1, .mcap and .db3 one file, else a folder, sqlite3 or mcap.

    ``packing``: "bz2" or "lz4" for ROS 1, "message", "file" or "storage" (of mcap) for ROS 2.
    ``begin_s``: when it is recorded.
    """

    def __init__(
        self, path: Path, storage: str = "sqlite3", packing: str = "none", begin_s: float = BEGIN_S
    ) -> None:
        self.is1, self.path = path.suffix == ".bag", path
        self._types = TYPES[self.is1]
        self._folder = path.with_suffix("") if path.suffix in ONE_FILE else path
        mcap = path.suffix == ".mcap" or storage == "mcap"
        plugin = StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3
        self._writer: Any = (
            Writer1(path) if self.is1 else Writer2(self._folder, version=9, storage_plugin=plugin)
        )
        if packing != "none" and self.is1:
            self._writer.set_compression(Writer1.CompressionFormat[packing.upper()])
        elif packing != "none":
            self._writer.set_compression(CompressionMode[packing.upper()], CompressionFormat.ZSTD)
        self._connections: dict[str, Any] = {}
        self._received_ns = int(begin_s * 1e9)

    def __enter__(self) -> BagMaker:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()
        if self.path.suffix in ONE_FILE:
            (inside,) = self._folder.glob(f"*{self.path.suffix}")
            inside.rename(self.path)

    def write(self, topic: str, stamp_s: float, stand_in: Any, frame_id: str = "optical") -> None:
        """The next message; it is received a millisecond after the one before."""
        kind = "CameraInfo" if hasattr(stand_in, "p") else "Image"
        if hasattr(stand_in, "format"):
            kind = "CompressedImage"
        name = f"sensor_msgs/msg/{kind}"
        self.write_message(topic, name, self._message(name, stamp_s, stand_in, frame_id))

    def write_transform(self, topic: str, T: np.ndarray, frames: tuple[str, str] | None) -> None:
        """A transform T_parent_child: of two frames as in /tf_static, else as RealSense's SDK."""
        types = self._types.types
        x, y, z, w = quaternion_from_rotation(T[:3, :3])
        transform = types["geometry_msgs/msg/Transform"](
            types["geometry_msgs/msg/Vector3"](*T[:3, 3]),
            types["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
        if frames is None:
            self.write_message(topic, "geometry_msgs/msg/Transform", transform)
            return
        stamp = types["builtin_interfaces/msg/Time"](0, 0)
        header = types["std_msgs/msg/Header"](*((0,) if self.is1 else ()), stamp, frames[0])
        one = types["geometry_msgs/msg/TransformStamped"](header, frames[1], transform)
        self.write_message(topic, "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"]([one]))

    def write_message(self, topic: str, name: str, message: Any) -> None:
        """A message of any type."""
        if topic not in self._connections:
            connect = self._writer.add_connection
            self._connections[topic] = connect(topic, name, typestore=self._types)
        store = self._types
        serialize = store.serialize_ros1 if self.is1 else store.serialize_cdr
        self._received_ns += 1_000_000
        self._writer.write(self._connections[topic], self._received_ns, serialize(message, name))

    def _message(self, name: str, stamp_s: float, stand_in: Any, frame_id: str) -> Any:
        types = self._types.types
        nanoseconds = round(stamp_s * 1e9)
        stamp = types["builtin_interfaces/msg/Time"](*divmod(nanoseconds, 1_000_000_000))
        sequence = (0,) if self.is1 else ()
        header = types["std_msgs/msg/Header"](*sequence, stamp, frame_id)
        given = dict(vars(stand_in))
        if "p" in given:
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            given |= {"r": np.eye(3).ravel(), "binning_x": 0, "binning_y": 0, "roi": roi}
            if self.is1:
                given = {k.upper() if k in "dkrp" else k: v for k, v in given.items()}
        return types[name](header=header, **given)


def write_bag(path: Path, frames: int = 4, storage: str = "sqlite3", packing: str = "none") -> Path:
    """A bag in TUM's layout: rgb8, and 32FC1 whose stamps are 4 ms later; four views in turn."""
    with BagMaker(path, storage, packing) as bag:
        bag.write(INFO, BEGIN_S, camera_info())
        for k in range(frames):
            frame, stamp_s = view(k % 4), BEGIN_S + k * STEP_S
            bag.write(RGB, stamp_s, image("rgb8", frame.rgb))
            bag.write(DEPTH, stamp_s + 0.004, image("32FC1", frame.depth_m))
    return path
