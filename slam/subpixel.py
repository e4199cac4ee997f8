"""Sub-pixel registration of matched keypoints to the image patch that made their landmark.

A corner is found to half a pixel at best, and anew in every image. The pose error that this causes
is why dense alignment beats plain features. Aligning the patch around each match with the
landmark's own patch (Lucas-Kanade, inverse compositional: Baker and Matthews 2004) leaves a
fraction of that; benchmarks/keypoint_noise.py measures it where the truth is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from graph.geometry import Array

PATCH_PX = 11  # side of a stored patch; the outermost ring only serves the gradients
_RADIUS = PATCH_PX // 2


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
    window = np.rint(_sample(gray, pixels, _RADIUS)).astype(np.uint8)
    return np.ascontiguousarray(window.transpose(2, 0, 1))


def register_patches(
    gray: NDArray[np.uint8], pixels: Array, patches: NDArray[np.uint8], iterations: int
) -> tuple[Array, Array]:
    """Where patches (M, 11, 11) lie in an image near pixels (M, 2).

    Each patch is aligned by translation, its brightness and contrast free. Returns the pixels
    (M, 2) and the correlation (M,) of patch and image there, -1 to 1.

    Inside, the patches are the last axis, so that every operation runs along contiguous memory.
    A gradient without its mean does not see the image's, and needs no normalised copy of it.
    """
    template = patches.transpose(1, 2, 0).astype(np.float32, order="C")
    half = np.float32(0.5)
    gx = _centred((template[1:-1, 2:] - template[1:-1, :-2]) * half)
    gy = _centred((template[2:, 1:-1] - template[:-2, 1:-1]) * half)
    inner = _centred(template[1:-1, 1:-1])
    contrast = _norm(inner)
    inner /= contrast
    xx, xy, yy = (_dot(gx, gx) + 1e-3, _dot(gx, gy), _dot(gy, gy) + 1e-3)
    determinant = xx * yy - xy * xy
    own_x, own_y = _dot(gx, inner), _dot(gy, inner)
    moved = pixels.astype(float)
    for _ in range(iterations):
        image = _centred(_sample(gray, moved, _RADIUS - 1))
        norm = _norm(image)
        bx = contrast * (_dot(gx, image) / norm - own_x)
        by = contrast * (_dot(gy, image) / norm - own_y)
        step = np.stack([yy * bx - xy * by, xx * by - xy * bx], axis=1) / determinant[:, None]
        moved -= np.clip(step, -1.0, 1.0)
    image = _centred(_sample(gray, moved, _RADIUS - 1))
    return moved, _dot(image, inner) / _norm(image)


def _centred(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Windows (S, S, M) as columns (S * S, M) of zero mean."""
    columns = values.reshape(values.shape[0] * values.shape[1], values.shape[2])
    return columns - columns.mean(axis=0)


def _dot(a: NDArray[np.float32], b: NDArray[np.float32]) -> Array:
    """Products (M,) of columns, in double precision from here on."""
    return np.einsum("km,km->m", a, b).astype(float)


def _norm(columns: NDArray[np.float32]) -> NDArray[np.float32]:
    """Norms (M,) of columns, never 0."""
    return np.sqrt(np.einsum("km,km->m", columns, columns)) + np.float32(1e-3)


def _sample(gray: NDArray[np.uint8], pixels: Array, radius: int) -> NDArray[np.float32]:
    """Windows (2r+1, 2r+1, M) float32 around pixels (M, 2), by linear interpolation.

    All pixels of a window share one fraction of a pixel. OpenCV's remap would round it to 1/32.
    """
    side = 2 * radius + 2
    limit = np.array(gray.shape[::-1]) - side
    corner = np.clip(pixels - radius, 0, limit - 1e-3)
    whole = np.floor(corner)
    column, row = whole.astype(np.int64).T
    a, b = (corner - whole).astype(np.float32).T
    steps = np.arange(side)
    offsets = (steps[:, None] * gray.shape[1] + steps)[:, :, None]
    window = gray.ravel()[offsets + (row * gray.shape[1] + column)].astype(np.float32)
    rows = window[:, :-1] + a * (window[:, 1:] - window[:, :-1])
    return rows[:-1] + b * (rows[1:] - rows[:-1])
