"""Sub-pixel registration of matched keypoints to the image patch that made their landmark.

A corner is found to half a pixel at best, and anew in every image. The pose error that this causes
is why dense alignment beats plain features. Aligning the patch around each match with the
landmark's own patch (Lucas-Kanade, inverse compositional: Baker and Matthews 2004) leaves a
fraction of that; benchmarks/keypoint_noise.py measures it where the truth is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from graph.geometry import Array

PATCH_PX = 11  # side of a stored patch; the outermost ring only serves the gradients
_RADIUS = PATCH_PX // 2
_INNER = (PATCH_PX - 2) ** 2  # pixels without that ring


@dataclass(frozen=True)
class SubpixelConfig:
    """``sigma_px`` is the standard deviation after registration; the rest are its gates.

    A registration counts if it moved the keypoint by less than ``max_shift_px`` times the square
    root of its scale and the patches then correlate by at least ``min_correlation``. A landmark
    gets a new patch where it is seen from more than ``max_angle_deg`` off the direction of the old
    one, or nearer or farther by more than the factor ``max_zoom``.
    """

    enabled: bool = True
    iterations: int = 4
    sigma_px: float = 0.2
    max_shift_px: float = 2.0
    min_correlation: float = 0.8
    max_angle_deg: float = 20.0
    max_zoom: float = 1.3


def cut_patches(gray: NDArray[np.uint8], pixels: Array) -> NDArray[np.uint8]:
    """Patches (M, 11, 11) uint8 around pixels (M, 2), interpolated linearly."""
    return np.rint(_sample(gray, pixels, _RADIUS)).astype(np.uint8)


def register_patches(
    gray: NDArray[np.uint8], pixels: Array, patches: NDArray[np.uint8], iterations: int
) -> tuple[Array, Array]:
    """Where patches (M, 11, 11) lie in an image near pixels (M, 2).

    Each patch is aligned by translation, its brightness and contrast free. Returns the pixels
    (M, 2) and the correlation (M,) of patch and image there, -1 to 1.
    """
    template = patches.astype(np.float32)
    gradient = np.stack(
        [
            (template[:, 1:-1, 2:] - template[:, 1:-1, :-2]).reshape(-1, _INNER) / 2,
            (template[:, 2:, 1:-1] - template[:, :-2, 1:-1]).reshape(-1, _INNER) / 2,
        ],
        axis=1,
    )
    gradient -= gradient.mean(axis=2, keepdims=True)
    inner, contrast = _normalised(template[:, 1:-1, 1:-1].reshape(-1, _INNER))
    hessian = np.einsum("mik,mjk->mij", gradient, gradient).astype(float)
    hessian += 1e-3 * np.eye(2)
    inverse_hessian = np.linalg.inv(hessian)
    moved = pixels.astype(float).copy()
    for _ in range(iterations):
        image = _normalised(_sample(gray, moved, _RADIUS - 1).reshape(-1, _INNER))[0]
        error = (image - inner) * contrast[:, None]
        steepest = np.einsum("mik,mk->mi", gradient, error)
        moved -= np.clip(np.einsum("mij,mj->mi", inverse_hessian, steepest), -1.0, 1.0)
    image = _normalised(_sample(gray, moved, _RADIUS - 1).reshape(-1, _INNER))[0]
    return moved, np.einsum("mk,mk->m", image, inner).astype(float)


def _normalised(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rows of zero mean and unit norm, and the norms they had."""
    centred = values - values.mean(axis=1, keepdims=True)
    norm = np.sqrt(np.einsum("mk,mk->m", centred, centred)) + np.float32(1e-3)
    return centred / norm[:, None], norm


def _sample(gray: NDArray[np.uint8], pixels: Array, radius: int) -> NDArray[np.float32]:
    """Windows (M, 2r+1, 2r+1) float32 around pixels (M, 2), by linear interpolation.

    All pixels of a window share one fraction of a pixel. OpenCV's remap would round it to 1/32.
    """
    side = 2 * radius + 1
    if len(pixels) == 0:
        return np.zeros((0, side, side), np.float32)
    limit = np.array(gray.shape[::-1]) - side - 1
    corner = np.clip(pixels - radius, 0, limit - 1e-3)
    column, row = np.floor(corner).astype(np.int64).T
    a, b = (corner - np.floor(corner)).astype(np.float32).T[:, :, None, None]
    window = sliding_window_view(gray, (side + 1, side + 1))[row, column].astype(np.float32)
    rows = window[:, :, :-1] + a * (window[:, :, 1:] - window[:, :, :-1])
    return rows[:, :-1] + b * (rows[:, 1:] - rows[:, :-1])
