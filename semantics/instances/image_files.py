"""Image files: decoded with a clear error for each way to be broken, and written whole."""

from __future__ import annotations

import io
import math
import os
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes

MAX_MEGAPIXELS = 100
LIMIT = "BMASK_SLAM_MAX_MEGAPIXELS"
"""The environment variable that sets another limit."""
FORMATS = ("PNG", "JPEG", "PPM", "BMP", "TIFF", "WEBP")
_TAIL_BYTES = 4096
_BYTES = {"I;16": 2, "I;16B": 2, "I": 4, "F": 4}
"""Of a value, by Pillow's mode, where it is not 1. A pixel of over 4 bytes counts as several."""
PNG = b"\x89PNG\r\n\x1a\n"
_PNG_CHUNK = 12
"""Bytes of a PNG's chunk beside its data: length, kind, checksum."""
_PNG_SIDES = slice(16, 24)
"""Where a PNG has its width and height, followed by how many bits a value has."""
_PNG_BITS, _PNG_COLOUR = 24, 25
_WITH_PALETTE = 3
_PNG_PIXELS_A_BYTE = 8 * 1032
"""More cannot come from a byte: of one bit each, at the highest ratio of deflate."""
warnings.filterwarnings("ignore", module=r"PIL\.")  # said here in one line
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def reduction(size: tuple[int, ...], wanted: tuple[int, ...]) -> int:
    """How many times as wide and as high as ``wanted`` a size (H, W) is; 0: no whole number."""
    k = size[0] // wanted[0]
    return k if size == tuple(k * side for side in wanted) else 0


def reduced_labels(values: NDArray, k: int) -> NDArray:
    """Values (k H, k W) that have no mean, at a k-th of their size."""
    return values[k // 2 :: k, k // 2 :: k]


def read_colour(path: Path) -> Image:
    """A colour image (H, W, 3), red first; grey images are expanded.

    Raises:
        InputError: a missing, truncated or unreadable file, or more than 8 bits a channel.
    """
    return _as_colour(decode_image(path, _COLOUR), str(path))


def decode_colour(data: bytes, where: str) -> Image:
    """``read_colour`` of the bytes of a file; ``where`` names their origin in errors."""
    return _as_colour(decode_bytes(data, _COLOUR, where), where)


def write_image(path: Path, picture: NDArray, options: Sequence[int] = ()) -> None:
    """Write an image (H, W, 3), red first, or grey (H, W) of 8 or 16 bits, as the suffix says.

    ``options`` are those of OpenCV, whose own writer takes a full disk for success.

    Raises:
        OSError: it cannot be written.
    """
    if picture.ndim == 3:
        picture = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    path.write_bytes(cv2.imencode(path.suffix, picture, options)[1].tobytes())


def _as_colour(bgr: NDArray, where: str) -> Image:
    if bgr.dtype != np.uint8:
        raise InputError(
            f"{where}: {8 * bgr.dtype.itemsize} bits a channel where colour is expected; "
            "list 8-bit colour images (are rgb and depth swapped?)"
        )
    return np.asarray(cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB), np.uint8)


def decode_image(path: Path, flags: int) -> NDArray:
    """The decoded image. A truncated file is refused; OpenCV would fill the rest with grey."""
    return decode_bytes(_content(path), flags, str(path))


def _content(path: Path) -> bytes:
    cure = "restore it or correct the list"
    if not path.exists():
        raise InputError(f"{path}: no such image; {cure}")
    return read_bytes(path, cure)


def decode_labels(path: Path) -> NDArray:
    """Values (H, W) of a label image; of a PNG with a palette its indices, not their colours."""
    data = _content(path)
    values = decode_bytes(data, cv2.IMREAD_UNCHANGED, str(path))
    if not data.startswith(PNG) or data[_PNG_COLOUR] != _WITH_PALETTE:
        return values
    try:
        return np.asarray(PIL.Image.open(io.BytesIO(data), formats=("PNG",)))
    except (OSError, ValueError, SyntaxError, PIL.Image.DecompressionBombError) as error:
        raise InputError(f"{path}: its palette cannot be read ({error}); write it again") from error


def decode_bytes(data: bytes, flags: int, where: str) -> NDArray:
    """An image from the bytes of its file; ``where`` names their origin in errors."""
    if not data:
        raise InputError(f"{where}: the image is empty (0 bytes); restore it or leave it out")
    tail = data[-_TAIL_BYTES:]
    truncated = (data.startswith(b"\xff\xd8") and b"\xff\xd9" not in tail) or (
        data.startswith(b"\x89PNG") and b"IEND" not in tail
    )
    image = None
    if not truncated and _has_possible_size(data, where):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        reason = "truncated" if truncated else "not a readable image"
        raise InputError(f"{where}: {reason} ({len(data)} bytes); restore it or leave it out")
    return image


def _has_possible_size(data: bytes, where: str) -> bool:
    """Whether the file's header can be read. Raises InputError if the image would be too large."""
    is_png = data.startswith(PNG)
    try:
        header = PIL.Image.open(io.BytesIO(data), formats=FORMATS)
        (width, height), bytes_each = header.size, len(header.getbands())
        bytes_each *= _BYTES.get(header.mode, 1)
        if is_png and data[_PNG_BITS] == 16:
            bytes_each = 2 * len(header.getbands())
    except PIL.Image.DecompressionBombError:
        width, height = struct.unpack(">II", data[_PNG_SIDES]) if is_png else (1 << 20, 1 << 20)
        bytes_each = 1
    except (OSError, ValueError, SyntaxError, OverflowError, struct.error):
        return False
    limit = _limit_megapixels()
    if width * height * max(1, bytes_each / 4) > limit * 1e6:
        raise InputError(
            f"{where}: {width} x {height} pixels, more than {limit:g} megapixels; scale it "
            f"down, or set {LIMIT}"
        )
    if not is_png:
        return True
    return width * height <= _PNG_PIXELS_A_BYTE * len(data) and _has_possible_chunks(data)


def _has_possible_chunks(data: bytes) -> bool:
    """Whether a PNG has all bytes that its chunks say, for which OpenCV takes memory at once."""
    begin = len(PNG)
    while begin + _PNG_CHUNK <= len(data):
        length, kind = struct.unpack_from(">I4s", data, begin)
        begin += _PNG_CHUNK + length
        if kind == b"IEND":
            return begin <= len(data)
    return False


def _limit_megapixels() -> float:
    """The limit in force. Raises InputError if the user has set something else than a number."""
    given = os.environ.get(LIMIT, "")
    try:
        limit = float(given or MAX_MEGAPIXELS)
    except ValueError:
        limit = math.nan
    if not 0 < limit < math.inf:
        raise InputError(f"{LIMIT}={given[:40]}: is no positive number; set megapixels, as 200")
    return limit
