"""Sub-pixel registration of matched keypoints to the image patch that made their landmark.

A corner detector is accurate to half a pixel at best, independently in every image; this is the
main pose error of feature-based methods against dense alignment. Aligning the patch around each
match with the landmark's own patch (Lucas-Kanade, inverse compositional: Baker and Matthews 2004)
leaves a fraction of that; benchmarks/suite/keypoint_noise.py measures it where the truth is exact.
The error is then no longer independent from image to image: all observations aligned with one patch
share it. So patches are compared at the scale of the view, and are few
(``WorldMap.renew_patches``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats, Image

PATCH_PX = 17  # side of a stored patch, with room for shrinking it
_RADIUS = 5  # side of the template; its outermost ring serves the gradients only


@dataclass(frozen=True)
class SubpixelConfig:
    """``sigma_px`` is the standard deviation after registration; the other values are limits.

    A registration is accepted if it moved the keypoint by less than ``max_shift_px`` times the
    square root of its scale and the patches then correlate by at least ``min_correlation``. A patch
    is used for views within ``max_angle_deg`` of its own direction, nearer or farther by at most
    the factor ``max_zoom``; a landmark gets a new one where none of its patches can be used.
    """

    enabled: bool = True
    iterations: int = 4
    sigma_px: float = 0.2
    max_shift_px: float = 2.0
    min_correlation: float = 0.8
    max_angle_deg: float = 20.0
    max_zoom: float = 1.5

    @property
    def limits(self) -> tuple[float, float]:
        """Limits between the views of patch and camera: angle in rad, ratio of distances."""
        return math.radians(self.max_angle_deg), self.max_zoom


def cut_patches(gray: Image, pixels: Array) -> Bytes:
    """Patches (M, 17, 17) uint8 around pixels (M, 2), interpolated linearly."""
    window = np.rint(_sample(gray, pixels, PATCH_PX // 2)).astype(np.uint8)
    return np.ascontiguousarray(window.transpose(2, 0, 1))


def register_patches(
    gray: Image,
    pixels: Array,
    patches: Bytes,
    iterations: int,
    zooms: Array | None = None,
) -> tuple[Array, Array]:
    """Where patches (M, 17, 17) lie in an image near pixels (M, 2).

    Each patch is first magnified by its zoom (M,), 1 if there is none: patches of different scale
    would be aligned with a systematic shift. Then it is aligned by a translation, with brightness
    and contrast free. Returns the pixels (M, 2) and the
    correlation (M,) of patch and image there, -1 to 1.

    Internally the patches are the last axis, so that every operation runs along contiguous memory.
    A zero-mean gradient is not affected by the mean of the image, which need not be subtracted.
    """
    zooms = np.ones(len(patches)) if zooms is None else zooms
    template = _zoomed(patches, zooms)
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


def _zoomed(patches: Bytes, zooms: Array) -> Floats:
    """The middles (11, 11, M) of patches (M, 17, 17), each magnified about its centre.

    Interpolated linearly; beyond a patch its border is repeated.
    """
    at = PATCH_PX // 2 + np.arange(-_RADIUS, _RADIUS + 1)[:, None] / zooms
    at = np.clip(at, 0, PATCH_PX - 1 - 1e-3)  # (11, M), alike for rows and columns
    whole = at.astype(np.int64)
    share = (at - whole).astype(np.float32)
    first = np.arange(len(patches)) * PATCH_PX**2
    corner = (first + whole * PATCH_PX)[:, None] + whole
    values = patches.reshape(-1).astype(np.float32)

    def along_row(start: int) -> Floats:
        left = values[start:].take(corner)
        return left + share * (values[start + 1 :].take(corner) - left)

    top = along_row(0)
    return top + share[:, None] * (along_row(PATCH_PX) - top)


def _centred(values: Floats) -> Floats:
    """Windows (S, S, M) as columns (S * S, M) of zero mean."""
    columns = values.reshape(values.shape[0] * values.shape[1], values.shape[2])
    return columns - columns.mean(axis=0)


def _dot(a: Floats, b: Floats) -> Array:
    """Products (M,) of columns, in double precision from here on."""
    return np.einsum("km,km->m", a, b).astype(float)


def _norm(columns: Floats) -> Floats:
    """Norms (M,) of columns, never 0."""
    return np.sqrt(np.einsum("km,km->m", columns, columns)) + np.float32(1e-3)


def _sample(gray: Image, pixels: Array, radius: int) -> Floats:
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
    window = gray.ravel().take(offsets + (row * gray.shape[1] + column)).astype(np.float32)
    rows = window[:, 1:] - window[:, :-1]
    rows *= a
    rows += window[:, :-1]
    between = rows[1:] - rows[:-1]
    between *= b
    between += rows[:-1]
    return between
