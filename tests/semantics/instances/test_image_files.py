"""Untrusted images: their size is checked before decoding."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.image_files import LIMIT, decode_bytes, read_colour, write_image


def png_header(width: int, height: int, bits: int = 8) -> bytes:
    """A PNG file of 69 bytes that claims a size, and has no pixels."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", width, height, bits, 2, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0\0\0\0")), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


@pytest.mark.parametrize(("width", "height"), [(40_000, 40_000), (2**31 - 1, 2**31 - 1)])
def test_a_huge_size_is_refused_before_decoding(tmp_path: Path, width: int, height: int) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png_header(width, height))
    size = f"{width} x {height} pixels"
    with pytest.raises(InputError, match=rf"bomb\.png: {size}, more than 100 megapixels"):
        read_colour(path)


def test_a_huge_size_of_sixteen_bits_is_refused_as_well() -> None:
    with pytest.raises(InputError, match=r"a: 40000 x 40000 pixels, more than 100 megapixels"):
        decode_bytes(png_header(40_000, 40_000, bits=16), cv2.IMREAD_UNCHANGED, "a")


@pytest.mark.parametrize("length", [0x7FFFFFFF, 0xFFFFFFF0, 40])
def test_a_chunk_is_no_longer_than_the_file(monkeypatch: pytest.MonkeyPatch, length: int) -> None:
    """Of the length that the first chunk of pixels states OpenCV took 4 GB, for 69 bytes."""
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    whole = png_header(4, 4)
    at = whole.index(b"IDAT")
    data = whole[: at - 4] + struct.pack(">I", length) + whole[at:]
    with pytest.raises(InputError, match="a: not a readable image"):
        decode_bytes(data, cv2.IMREAD_COLOR, "a")


def test_another_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    data = cv2.imencode(".png", np.zeros((300, 400, 3), np.uint8))[1].tobytes()
    assert decode_bytes(data, cv2.IMREAD_COLOR, "a").shape == (300, 400, 3)
    monkeypatch.setenv(LIMIT, "0.1")
    with pytest.raises(InputError, match=r"400 x 300 pixels, more than 0\.1 megapixels"):
        decode_bytes(data, cv2.IMREAD_COLOR, "a")


@pytest.mark.parametrize("limit", ["abc", "nan", "inf", "0", "-1"])
def test_a_limit_that_is_none(monkeypatch: pytest.MonkeyPatch, limit: str) -> None:
    monkeypatch.setenv(LIMIT, limit)
    with pytest.raises(InputError, match=f"{LIMIT}={limit}: is no positive number"):
        decode_bytes(png_header(4, 4), cv2.IMREAD_COLOR, "a")


def test_what_is_written_is_read_or_the_disk_is_full(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).integers(0, 255, (30, 40, 3), np.uint8)
    depth = rgb[..., 0].astype(np.uint16) * 200
    for name, picture in (("a.png", rgb), ("b.png", depth)):
        write_image(tmp_path / name, picture)
    np.testing.assert_array_equal(read_colour(tmp_path / "a.png"), rgb)
    read = decode_bytes((tmp_path / "b.png").read_bytes(), cv2.IMREAD_UNCHANGED, "b")
    np.testing.assert_array_equal(read, depth)
    with pytest.raises(OSError, match="No such file"):
        write_image(tmp_path / "nowhere" / "a.png", rgb)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm"])
def test_the_usual_formats(suffix: str) -> None:
    data = cv2.imencode(suffix, np.full((30, 40, 3), 90, np.uint8))[1].tobytes()
    assert abs(int(decode_bytes(data, cv2.IMREAD_COLOR, "a").mean()) - 90) <= 1


@pytest.mark.parametrize("data", [b"", b"\x89PNG", b"\xff\xd8\xff\xd9", b"II*\0" + b"\xff" * 40])
def test_what_is_no_image_is_one_line(data: bytes) -> None:
    with pytest.raises(InputError, match=r"a: .*; restore it or leave it out"):
        decode_bytes(data, cv2.IMREAD_COLOR, "a")
