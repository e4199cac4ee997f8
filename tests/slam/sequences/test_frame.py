"""Frames from a caller: broken ones are refused, and zeros in depth become NaN."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.frame import Frame, check_frame

CAMERA = Camera(4, 3, fx=5.0, fy=5.0, cx=1.5, cy=1.0)
DEPTH_M = np.full((3, 4), 2.0, np.float32)
GOOD = Frame(0, 1.5, np.zeros((3, 4, 3), np.uint8), DEPTH_M, "a.png")


def with_depth(value: float, dtype: Any = np.float32) -> np.ndarray:
    depth_m = DEPTH_M.astype(dtype)
    depth_m[1, 2] = value
    return depth_m


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rgb": GOOD.rgb[:, :, 0]}, r"colour is uint8 \(3, 4\), .* uint8 \(3, 4, 3\)"),
        ({"rgb": GOOD.rgb[:2]}, r"colour is uint8 \(2, 4, 3\)"),
        ({"rgb": GOOD.rgb.astype(np.float32)}, "colour is float32"),
        ({"rgb": GOOD.rgb.tolist()}, "colour is a list"),
        ({"depth_m": DEPTH_M[:2]}, r"depth is float32 \(2, 4\)"),
        ({"depth_m": DEPTH_M[..., None]}, "depth is float32"),
        ({"depth_m": (1000 * DEPTH_M).astype(np.uint16)}, "depth is uint16 .* metres"),
        ({"depth_m": None}, "depth is a NoneType"),
        ({"depth_m": with_depth(np.inf)}, "negative or infinite"),
        ({"depth_m": with_depth(-np.inf)}, "negative or infinite"),
        ({"depth_m": with_depth(-0.5)}, "negative or infinite"),
        ({"depth_m": with_depth(1e300, np.float64)}, "negative or infinite"),
        ({"timestamp_s": float("nan")}, "not a finite number"),
        ({"timestamp_s": float("inf")}, "not a finite number"),
        ({"timestamp_s": "1.5"}, "not a finite number"),
    ],
)
def test_a_broken_frame_is_refused(change: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_frame(replace(GOOD, **change), CAMERA)


@pytest.mark.parametrize("last_stamp_s", [1.5, 1.6])
def test_a_stamp_that_does_not_go_forward_is_refused(last_stamp_s: float) -> None:
    with pytest.raises(InputError, match=f"frame at 1.5: not later .* {last_stamp_s}"):
        check_frame(GOOD, CAMERA, last_stamp_s)


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_zero_depth_becomes_nan_in_a_copy(dtype: Any) -> None:
    given = with_depth(0.0, dtype)
    given[0, 0] = np.nan
    before = given.copy()
    frame = check_frame(replace(GOOD, depth_m=given), CAMERA, 1.4)
    assert frame.depth_m.dtype == np.float32
    assert np.argwhere(np.isnan(frame.depth_m)).tolist() == [[0, 0], [1, 2]]
    assert (frame.index, frame.timestamp_s, frame.name) == (0, 1.5, "a.png")
    np.testing.assert_array_equal(given, before)


def test_good_depth_is_not_copied() -> None:
    assert check_frame(GOOD, CAMERA).depth_m is DEPTH_M


def test_a_frame_without_any_depth_is_used() -> None:
    empty = np.full_like(DEPTH_M, np.nan)
    assert np.isnan(check_frame(replace(GOOD, depth_m=empty), CAMERA).depth_m).all()
