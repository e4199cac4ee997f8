"""BRISK for all keypoints at once, against OpenCV's, one keypoint after the other."""

import cv2
import numpy as np
import pytest
from synthetic_view import render_plane

from bmask_slam.features.fixed_size_descriptor import FixedSizeBrisk, box_kernel
from bmask_slam.features.matching import hamming
from bmask_slam.graph.geometry import se3_exp

SIZES_PX = (12.0, 18.0)
NOISE = np.random.default_rng(2).integers(0, 256, (480, 640)).astype(np.uint8)
PLANE = cv2.cvtColor(
    render_plane(se3_exp(np.array([0.05, 0.1, 0.4, 0, 0, 0]))).rgb, cv2.COLOR_RGB2GRAY
)
IMAGES = {"noise": cv2.GaussianBlur(NOISE, (0, 0), 1.5), "plane": PLANE}


def corners(gray: np.ndarray, border: int = 40) -> np.ndarray:
    inside = np.zeros_like(gray)
    inside[border:-border, border:-border] = 255
    return cv2.KeyPoint_convert(cv2.FastFeatureDetector_create(15).detect(gray, inside))[:600]


def by_opencv(gray: np.ndarray, pixels: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    keypoints = cv2.KeyPoint_convert(pixels.astype(np.float32), size)
    kept, bits = cv2.BRISK_create().compute(gray, keypoints)
    assert len(kept) == len(pixels)
    return bits.view(np.uint64), np.deg2rad([keypoint.angle for keypoint in kept])


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.abs((a - b + np.pi) % (2 * np.pi) - np.pi)


@pytest.mark.parametrize("size", SIZES_PX)
@pytest.mark.parametrize("name", IMAGES)
def test_bits_and_orientation_equal_opencvs(name: str, size: float) -> None:
    """Except for the few bits that depend on the summation of subpixel boxes."""
    gray = IMAGES[name]
    pixels = corners(gray)
    assert len(pixels) > 200
    expected, angles = by_opencv(gray, pixels, size)
    descriptors, own_angles = FixedSizeBrisk(size).describe(gray, pixels)
    distance = hamming(descriptors, expected)
    assert np.median(distance) < 15
    assert np.percentile(distance, 95) < 40  # of 512, where strangers differ by 200
    assert np.median(apart(angles, own_angles)) < np.deg2rad(1)
    assert ((own_angles >= 0) & (own_angles < 2 * np.pi)).all()


def test_rotating_the_image_rotates_the_orientation_and_keeps_the_bits() -> None:
    gray = IMAGES["noise"]
    pixels, brisk = corners(gray), FixedSizeBrisk(12.0)
    descriptors, angles = brisk.describe(gray, pixels)
    turned = np.ascontiguousarray(np.rot90(gray))  # (u, v) goes to (v, width - 1 - u)
    there = np.column_stack([pixels[:, 1], gray.shape[1] - 1 - pixels[:, 0]])
    again, turned_angles = brisk.describe(turned, there)
    assert np.median(hamming(descriptors, again)) < 15
    assert np.median(apart(turned_angles, angles - np.pi / 2)) < np.deg2rad(2)


def test_the_reach_covers_every_pixel_that_matters() -> None:
    brisk, pixel = FixedSizeBrisk(12.0), np.array([[320.0, 240.0]])
    other = IMAGES["noise"].copy()
    other[
        240 - brisk.reach_px : 241 + brisk.reach_px, 320 - brisk.reach_px : 321 + brisk.reach_px
    ] = 255 - IMAGES["noise"][220:261, 300:341]
    assert brisk.reach_px == 20  # of OpenCV's pattern: nearer to the border it gives none
    outside = np.where(other == IMAGES["noise"], 0, IMAGES["noise"]).astype(np.uint8)
    for a, b in zip(
        brisk.describe(IMAGES["noise"], pixel), brisk.describe(outside, pixel), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def test_no_keypoints_and_a_blank_image() -> None:
    brisk, blank = FixedSizeBrisk(12.0), np.full((100, 100), 90, np.uint8)
    descriptors, angles = brisk.describe(blank, np.zeros((0, 2), np.float32))
    assert descriptors.shape == (0, 8)
    assert angles.shape == (0,)
    descriptors, angles = brisk.describe(blank, np.array([[50.0, 50.0]]))
    assert not descriptors.any()
    assert not angles.any()


@pytest.mark.parametrize("side", [1.0, 1.3, 2.0, 3.0, 3.4, 5.9])
def test_a_box_covers_its_outermost_pixels_in_part(side: float) -> None:
    weights = box_kernel(side)
    fine = np.zeros(len(weights) * 1000)
    half = round(side * 500)
    fine[len(fine) // 2 - half : len(fine) // 2 + half] = 1 / (2 * half)
    np.testing.assert_allclose(weights, fine.reshape(len(weights), 1000).sum(axis=1), atol=1e-9)
