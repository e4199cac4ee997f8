"""Messages of every encoding are decoded to the image that was encoded."""

from __future__ import annotations

import array
import struct

import cv2
import numpy as np
import pytest
from recorded_bags import camera_info, compressed, image, view

from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.ros_images import (
    camera_of,
    colour_image,
    depth_encoding,
    depth_image,
)

FRAME = view(3)
RGB, DEPTH_M = FRAME.rgb, FRAME.depth_m
DEPTH_MM = np.nan_to_num(1000 * DEPTH_M).astype(np.uint16)


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RGB),
        ("bgr8", RGB[..., ::-1]),
        ("8UC3", RGB[..., ::-1]),
        ("rgba8", np.dstack([RGB, RGB[..., 0]])),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]])),
    ],
)
@pytest.mark.parametrize("padding", [0, 5])
def test_raw_colour(encoding: str, pixels: np.ndarray, padding: int) -> None:
    assert np.array_equal(colour_image(image(encoding, pixels, padding), "here"), RGB)


def test_data_may_be_bytes_or_an_array() -> None:
    message = image("rgb8", RGB)
    for data in (message.data.tobytes(), array.array("B", message.data.tobytes())):
        message.data = data
        assert np.array_equal(colour_image(message, "here"), RGB)


def test_grey_is_expanded() -> None:
    grey = RGB[..., 1]
    assert np.array_equal(colour_image(image("mono8", grey), "here"), np.dstack([grey] * 3))


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_decoded_to_the_colours(pattern: str) -> None:
    """The pattern names the first two pixels of the first row, then of the second."""
    colours = np.zeros((24, 32, 3), np.uint8)
    colours[:, :16], colours[:, 16:] = (200, 90, 20), (30, 60, 220)
    mosaic = np.zeros((24, 32), np.uint8)
    for place, colour in enumerate(pattern):
        row, column = divmod(place, 2)
        mosaic[row::2, column::2] = colours[row::2, column::2, "rgb".index(colour)]
    found = colour_image(image(f"bayer_{pattern}8", mosaic), "here").astype(int)
    for columns in (slice(2, 13), slice(19, 30)):
        assert np.abs(found[2:-2, columns] - colours[2:-2, columns]).max() <= 1


@pytest.mark.parametrize(
    ("form", "suffix", "bgr"),
    [
        ("rgb8; png compressed bgr8", ".png", RGB[..., ::-1]),
        ("rgb8; jpeg compressed bgr8", ".jpg", RGB[..., ::-1]),
        ("rgb8; png compressed rgb8", ".png", RGB),  # red and blue exchanged within the file
        ("png", ".png", RGB[..., ::-1]),
    ],
)
def test_compressed_colour(form: str, suffix: str, bgr: np.ndarray) -> None:
    found = colour_image(compressed(form, suffix, np.ascontiguousarray(bgr)), "here").astype(int)
    assert np.abs(found - RGB)[12:].mean() < (8 if suffix == ".jpg" else 1e-9)


@pytest.mark.parametrize("big_endian", [False, True])
def test_raw_depth(big_endian: bool) -> None:
    millimetres = depth_image(image("16UC1", DEPTH_MM, 6, big_endian), "here")
    assert millimetres.dtype == np.uint16
    assert np.array_equal(millimetres, DEPTH_MM)
    metres = depth_image(image("32FC1", DEPTH_M, 0, big_endian), "here")
    assert metres.dtype == np.float32
    assert np.array_equal(metres, DEPTH_M, equal_nan=True)


def test_compressed_depth_in_millimetres() -> None:
    for form, head in (("16UC1; compressedDepth png", bytes(12)), ("16UC1; png compressed ", b"")):
        message = compressed(form, ".png", DEPTH_MM, head)
        assert depth_encoding(message, "here") == "16UC1"
        assert np.array_equal(depth_image(message, "here"), DEPTH_MM)


def test_compressed_depth_in_metres() -> None:
    """Inverse depth q = A / z + B, rounded: the sigma of z is z^2 / A / sqrt(12)."""
    scale = 100.0 * 101.0
    offset = 1.0 - scale / 10.0
    stored = np.nan_to_num(np.rint(scale / DEPTH_M + offset)).astype(np.uint16)
    head = struct.pack("<iff", 0, scale, offset)
    found = depth_image(compressed("32FC1; compressedDepth", ".png", stored, head), "here")
    assert np.array_equal(np.isnan(found), np.isnan(DEPTH_M))
    assert np.nanmax(np.abs(found - DEPTH_M) / DEPTH_M**2) < 0.55 / scale


@pytest.mark.parametrize(
    ("message", "reason"),
    [
        (image("16UC1", DEPTH_MM), "colour is expected"),
        (image("rgb8", RGB[:, :-1]), None),
        (compressed("rgb8; jpeg compressed bgr8", ".jpg", RGB), None),
    ],
)
def test_broken_colour_is_refused(message: object, reason: str | None) -> None:
    message.data = message.data[:-100]
    with pytest.raises(InputError, match=rf"^here: .*{reason or ''}"):
        colour_image(message, "here")


@pytest.mark.parametrize(
    "message",
    [
        image("rgb8", RGB),
        compressed("16UC1; compressedDepth rvl", ".png", DEPTH_MM, bytes(12)),
        compressed("32FC1; png compressed", ".png", DEPTH_MM),
        compressed("16UC1; compressedDepth png", ".png", RGB, bytes(12)),
    ],
)
def test_messages_that_are_not_depth_are_refused(message: object) -> None:
    with pytest.raises(InputError, match=r"^here: "):
        depth_image(message, "here")


def test_the_camera_of_raw_and_rectified_images() -> None:
    camera, lens = camera_of(camera_info(), 1.0, rectified=False, where="here")
    assert lens is None
    assert (camera.width, camera.height) == (160, 120)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (131.25, 130.0, 79.625, 60.375)
    assert camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.05)
    rectified, _ = camera_of(camera_info(), 1.0, rectified=True, where="here")
    assert (rectified.fx, rectified.cx, rectified.cy) == (100.0, 80.0, 60.0)
    assert not any(rectified.distortion)


def test_an_uncalibrated_or_unsupported_camera_is_refused() -> None:
    info = camera_info()
    info.distortion_model = "double_sphere"
    with pytest.raises(InputError, match=r"here: distortion 'double_sphere'.*--camera"):
        camera_of(info, 1.0, rectified=False, where="here")
    info.distortion_model = "equidistant"
    with pytest.raises(InputError, match="here: a lens with 5 distortion coefficients, not 4"):
        camera_of(info, 1.0, rectified=False, where="here")
    broken = camera_info((0.1, 0, 0, 0, 0, np.inf, 0, 0))
    broken.distortion_model = "rational_polynomial"
    with pytest.raises(InputError, match="here: a lens with a number that is not finite"):
        camera_of(broken, 1.0, rectified=False, where="here")
    with pytest.raises(InputError, match="distortion"):
        camera_of(camera_info((0.1, 0, 0, 0, 0, 0.2, 0, 0)), 1.0, rectified=False, where="here")
    zeros = camera_info(())
    zeros.k = np.zeros(9)
    with pytest.raises(InputError, match="focal lengths of 0 and 0 px; give --camera"):
        camera_of(zeros, 1.0, rectified=False, where="here")


def test_bgr_images_agree_between_opencv_and_ros() -> None:
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 2] = 255  # OpenCV's red
    data = cv2.imencode(".png", red)[1]
    message = compressed("bgr8; png compressed bgr8", ".png", red)
    assert np.array_equal(message.data, data)
    assert colour_image(message, "here")[0, 0].tolist() == [255, 0, 0]
