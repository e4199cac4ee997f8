"""Registration of patches: known shifts of smooth random images."""

import cv2
import numpy as np
import pytest

from bmask_slam.features.patch_alignment import PATCH_PX, cut_patches, register_patches

RNG = np.random.default_rng(3)
HALF = PATCH_PX // 2
MIDDLE = np.array([160.0, 120.0])


def smooth_spectrum(seed: int) -> np.ndarray:
    """Waves (K, 4) of a smooth random image: frequency x, y (rad/px), phase, amplitude."""
    rng = np.random.default_rng(seed)
    direction, frequency = rng.uniform(0, 2 * np.pi, 60), rng.uniform(0.1, 0.7, 60)
    waves = [frequency * np.cos(direction), frequency * np.sin(direction)]
    return np.stack([*waves, rng.uniform(0, 2 * np.pi, 60), rng.uniform(4, 12, 60)], axis=1)


def image(
    shift: tuple[float, float] = (0.0, 0.0),
    gain: float = 1.0,
    offset: float = 0.0,
    zoom: float = 1.0,
) -> np.ndarray:
    """The analytic image (240, 320) uint8, its content moved by ``shift`` (right, down) px.

    After that it is magnified about ``MIDDLE``.
    """
    u, v = (
        (np.arange(n) - m) / zoom + m - s
        for n, m, s in zip((320.0, 240.0), MIDDLE, shift, strict=True)
    )
    u, v = np.meshgrid(u, v)
    value = sum(
        a * np.sin(fx * u + fy * v + phase) for fx, fy, phase, a in smooth_spectrum(1).tolist()
    )
    return np.rint(np.clip(128 + offset + gain * 0.65 * value, 0, 255)).astype(np.uint8)


def corners() -> np.ndarray:
    """Whole pixels (60, 2) that fix a position in both directions, as a detector chooses them."""
    mask = np.zeros((240, 320), np.uint8)
    mask[25:-25, 25:-25] = 1
    found = cv2.goodFeaturesToTrack(image(), 60, 0.01, 12, mask=mask, blockSize=9)
    return found[:, 0].astype(float)


CORNERS = corners()
PIXELS = CORNERS + RNG.uniform(-0.5, 0.5, CORNERS.shape)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, -0.4), (-0.75, 0.6), (1.2, 0.9)])
@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (0.7, 25.0), (1.15, -5.0)])
def test_a_known_shift_is_found(shift: tuple[float, float], gain: float, offset: float) -> None:
    """Under a change of contrast and brightness too; pixels whole, so that cutting is exact."""
    start = CORNERS
    patches = cut_patches(image(), start)
    moved, correlation = register_patches(image(shift, gain, offset), start, patches, 10)
    error = moved - start - shift
    assert np.sqrt(np.mean(error**2)) < 0.02
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert correlation.min() > 0.95


def test_a_patch_cut_at_a_subpixel_position_is_found() -> None:
    """No bias: the same fraction of a pixel is found in the same image."""
    patches = cut_patches(image(), PIXELS)
    start = PIXELS + RNG.uniform(-0.8, 0.8, PIXELS.shape)
    moved, correlation = register_patches(image(), start, patches, 10)
    assert np.sqrt(np.mean((moved - PIXELS) ** 2)) < 0.02
    assert np.abs((moved - PIXELS).mean(axis=0)).max() < 0.01
    assert correlation.min() > 0.98


@pytest.mark.parametrize("zoom", [0.72, 0.8, 0.9, 1.1, 1.25, 1.4])
def test_a_patch_is_found_at_another_zoom(zoom: float) -> None:
    """A template of another scale has a bias of its own at every corner."""
    there = MIDDLE + zoom * (CORNERS - MIDDLE)
    inside = (np.abs(there - MIDDLE) < MIDDLE - 15).all(axis=1)
    patches, there = cut_patches(image(), CORNERS[inside]), there[inside]
    assert len(there) > 20
    errors = {}
    for known in (False, True):
        zooms = np.full(len(there), zoom) if known else None
        moved, correlation = register_patches(image(zoom=zoom), there, patches, 10, zooms)
        errors[known] = np.sqrt(np.mean((moved - there) ** 2))
    assert errors[True] < 0.05
    assert errors[True] < 0.3 * errors[False]
    assert correlation.min() > 0.95


def test_every_patch_has_its_own_zoom() -> None:
    zooms = RNG.uniform(0.75, 1.3, len(PIXELS))
    patches = cut_patches(image(), PIXELS)
    together = register_patches(image(zoom=1.1), PIXELS, patches, 3, zooms)
    for k in range(0, len(PIXELS), 7):
        alone = register_patches(image(zoom=1.1), PIXELS[[k]], patches[[k]], 3, zooms[[k]])
        np.testing.assert_allclose(together[0][k], alone[0][0], atol=1e-6)
        np.testing.assert_allclose(together[1][k], alone[1][0], atol=1e-6)


def test_patch_pixels_are_column_row() -> None:
    gray = image()
    patch = cut_patches(gray, np.array([[100.0, 60.0]]))[0]
    np.testing.assert_array_equal(patch, gray[60 - HALF : 61 + HALF, 100 - HALF : 101 + HALF])


def test_subpixel_patches_equal_opencvs() -> None:
    gray = image()
    patches = cut_patches(gray, PIXELS)
    for pixel, patch in zip(PIXELS, patches, strict=True):
        slow = cv2.getRectSubPix(gray, (PATCH_PX, PATCH_PX), pixel.tolist())
        assert np.abs(slow.astype(int) - patch).max() <= 1


def test_correlation_distinguishes_another_patch() -> None:
    patches = cut_patches(image(), PIXELS)
    _, correlation = register_patches(image(), PIXELS[::-1].copy(), patches, 0)
    assert np.abs(np.median(correlation)) < 0.3
    negative = (255 - image()).astype(np.uint8)
    _, correlation = register_patches(negative, PIXELS, patches, 0)
    assert correlation.max() < -0.95


def test_a_flat_patch_has_no_shift_and_no_correlation() -> None:
    flat = np.full((240, 320), 90, np.uint8)
    patches = cut_patches(flat, PIXELS)
    moved, correlation = register_patches(image(), PIXELS, patches, 6)
    assert np.isfinite(moved).all()
    assert np.abs(correlation).max() < 0.1
    moved, correlation = register_patches(flat, PIXELS, cut_patches(image(), PIXELS), 6)
    assert np.isfinite(moved).all()
    assert np.abs(correlation).max() < 0.1


def test_pixels_at_the_image_border_are_handled() -> None:
    corners = np.array([[0.0, 0.0], [319.0, 0.0], [0.0, 239.0], [319.0, 239.0], [-3.0, 250.0]])
    patches = cut_patches(image(), corners)
    assert patches.shape == (5, PATCH_PX, PATCH_PX)
    moved, _ = register_patches(image(), corners, patches, 6)
    assert np.isfinite(moved).all()


def test_no_patches_are_registered() -> None:
    none = np.zeros((0, 2))
    patches = cut_patches(image(), none)
    assert patches.shape == (0, PATCH_PX, PATCH_PX)
    moved, correlation = register_patches(image(), none, patches, 6)
    assert moved.shape == (0, 2)
    assert correlation.shape == (0,)
