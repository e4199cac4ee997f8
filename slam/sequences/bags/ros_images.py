"""ROS image messages as arrays: sensor_msgs Image, CompressedImage and CameraInfo.

A message is anything with the fields of its type, whatever library made it.
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError, naming
from bmask_slam.semantics.instances.image_files import decode_bytes
from bmask_slam.sequences.images import Lens

_RAW: dict[str, tuple[str, int]] = {
    "rgb8": ("u1", 3), "bgr8": ("u1", 3), "8UC3": ("u1", 3),
    "rgba8": ("u1", 4), "bgra8": ("u1", 4), "mono8": ("u1", 1), "8UC1": ("u1", 1),
    "bayer_rggb8": ("u1", 1), "bayer_bggr8": ("u1", 1),
    "bayer_gbrg8": ("u1", 1), "bayer_grbg8": ("u1", 1),
    "16UC1": ("u2", 1), "mono16": ("u2", 1), "32FC1": ("f4", 1),
}  # fmt: skip
"""Element type and channels of a pixel, by encoding."""
_TO_RGB = {
    "rgb8": None, "bgr8": cv2.COLOR_BGR2RGB, "8UC3": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB, "bgra8": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB, "8UC1": cv2.COLOR_GRAY2RGB,
    "bayer_rggb8": cv2.COLOR_BayerRGGB2RGB, "bayer_bggr8": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGBRG2RGB, "bayer_grbg8": cv2.COLOR_BayerGRBG2RGB,
}  # fmt: skip
DEPTH_SCALES = {"16UC1": 1000.0, "mono16": 1000.0, "32FC1": 1.0}
"""Stored depth of one metre by encoding (REP 118: millimetres, or metres)."""
_DEPTH_HEADER = "<iff"
"""Header of a compressedDepth image: format, and A and B of its quantised inverse depth."""
_FIVE = ("plumb_bob", "rational_polynomial", "")
"""Distortion models whose first five coefficients are OpenCV's k1, k2, p1, p2, k3."""
_FISHEYE = ("equidistant", "fisheye")
_LENSES = ("rational_polynomial", *_FISHEYE)
"""Models with more than these five, by which images are undistorted."""


def stamp_s(header: Any) -> float:
    """The stamp of a message's header in seconds."""
    stamp = header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def colour_image(message: Any, where: str) -> Image:
    """The image (H, W, 3), red first.

    Raises:
        InputError: an encoding that is not colour, or broken data; ``where`` begins the text.
    """
    if hasattr(message, "format"):
        image = decode_bytes(bytes(message.data), cv2.IMREAD_COLOR, where)
        rgb_inside = message.format.split()[-1:] == ["rgb8"]  # as "rgb8; jpeg compressed rgb8"
        return np.asarray(image if rgb_inside else cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
    if message.encoding not in _TO_RGB:
        raise InputError(
            f"{where}: encoding {message.encoding!r} where colour is expected; known are "
            f"{', '.join(_TO_RGB)}"
        )
    code, image = _TO_RGB[message.encoding], _raw_image(message, where)
    return np.asarray(image if code is None else cv2.cvtColor(image, code))


def depth_image(message: Any, where: str) -> NDArray:
    """The stored depth (H, W): uint16, or float32 with NaN where it is missing.

    Raises:
        InputError: as for ``colour_image``.
    """
    encoding = depth_encoding(message, where)
    if not hasattr(message, "format"):
        return _raw_image(message, where)
    data = bytes(message.data)
    if "compressedDepth" in message.format:
        size = struct.calcsize(_DEPTH_HEADER)
        head, data = data[:size], data[size:]
    elif encoding == "32FC1":
        raise InputError(f"{where}: format {message.format!r} cannot hold metres; record raw depth")
    stored = decode_bytes(data, cv2.IMREAD_UNCHANGED, where)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise InputError(f"{where}: {stored.dtype} {stored.shape} where 16-bit depth is expected")
    if encoding != "32FC1":
        return stored
    _, scale, offset = struct.unpack(_DEPTH_HEADER, head)
    with np.errstate(divide="ignore"):
        depth_m = np.float32(scale) / (stored.astype(np.float32) - np.float32(offset))
    return np.where(stored > 0, depth_m, np.float32(np.nan))


def depth_encoding(message: Any, where: str) -> str:
    """The encoding of a raw or compressed depth image: a key of DEPTH_SCALES.

    Raises:
        InputError: an encoding that is not depth, or depth compressed in another way than by PNG.
    """
    compressed = hasattr(message, "format")
    name = message.format.partition(";")[0].strip() if compressed else message.encoding
    if name not in DEPTH_SCALES or (compressed and "rvl" in message.format):
        given = message.format if compressed else name
        raise InputError(
            f"{where}: {given!r} where depth is expected; known are {', '.join(DEPTH_SCALES)}, "
            "raw or as compressedDepth png"
        )
    return name


def camera_of(
    info: Any, depth_scale: float, rectified: bool, where: str
) -> tuple[Camera, Lens | None]:
    """The camera of a CameraInfo message: K and D, or P without distortion if ``rectified``.

    And the lens, where D is more than a camera can say: the camera is that of its images once they
    are undistorted.

    Raises:
        InputError: it is not calibrated, or its distortion is of no model that is known.
    """
    cure = "give --camera F"
    if rectified:
        K, terms = np.asarray(_field(info, "p"), float).reshape(3, 4)[:, :3], np.zeros(5)
    else:
        K = np.asarray(_field(info, "k"), float).reshape(3, 3)
        terms = np.asarray(_field(info, "d"), float)
    if not (K[0, 0] > 0 and K[1, 1] > 0 and np.isfinite(K).all()):
        raise InputError(f"{where}: focal lengths of {K[0, 0]:g} and {K[1, 1]:g} px; {cure}")
    model, fisheye = info.distortion_model, info.distortion_model in _FISHEYE
    beyond = bool(terms.any() if fisheye else terms[5:].any())
    if terms.any() and model not in (_LENSES if beyond else _FIVE):
        raise InputError(
            f"{where}: distortion {model!r} {terms.tolist()} is not k1, k2, p1, p2, k3, nor of "
            f"{', '.join(_LENSES)}; rectify the images, or {cure}"
        )
    k1, k2, p1, p2, k3 = [*(() if beyond else map(float, terms)), *[0.0] * 5][:5]
    fx, fy, cx, cy = map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    size, five = (int(info.width), int(info.height)), (k1, k2, p1, p2, k3)
    with naming(where, cure):
        camera = Camera(*size, fx, fy, cx, cy, five, depth_scale)
    if not beyond:
        return camera, None
    lens = Lens(camera, tuple(map(float, terms)), fisheye)
    if fault := lens.fault():
        raise InputError(f"{where}: a lens with {fault}; {cure}")
    return camera, lens


def _field(info: Any, name: str) -> Any:
    """A field of CameraInfo, whose name is upper case in ROS 1."""
    return getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())


def _raw_image(message: Any, where: str) -> NDArray:
    """The pixels (H, W) or (H, W, C) of an Image, whose rows may be padded."""
    kind, channels = _RAW[message.encoding]
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    data = np.frombuffer(message.data, np.uint8)
    if not height or not width or step < row_bytes or len(data) < height * step:
        raise InputError(
            f"{where}: {len(data)} bytes in rows of {step} for {width}x{height} {message.encoding}"
        )
    rows = data[: height * step].reshape(height, step)[:, :row_bytes]
    image = np.ascontiguousarray(rows).view(dtype).astype(dtype.newbyteorder("="), copy=False)
    return image.reshape((height, width, channels) if channels > 1 else (height, width))
