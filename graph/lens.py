"""Lens distortion: OpenCV's model of five coefficients, its inverse and its derivatives."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError

UNDISTORTION_STEPS = 5


def columns(first: Array, *others: Array) -> Array:
    """Arrays (...) side by side (..., K), of the first one's shape and type."""
    joined = np.empty((*first.shape, 1 + len(others)), first.dtype)
    for number, column in enumerate((first, *others)):
        joined[..., number] = column
    return joined


def five_terms(given: Sequence[float] | Array) -> tuple[float, float, float, float, float]:
    """OpenCV's (k1, k2, p1, p2, k3) of five values or, where k3 is 0, of four. InputError."""
    terms = given if isinstance(given, tuple) else np.ravel(given).tolist()
    if len(terms) not in (4, 5):
        raise InputError(
            f"a camera with {len(terms)} values of distortion; give (k1, k2, p1, p2, k3) of "
            "OpenCV, or undistort the images first"
        )
    k1, k2, p1, p2, k3 = (*terms, 0.0)[:5]
    return k1, k2, p1, p2, k3


def distort_normalised(normalised: Array, distortion: Sequence[float] | Array) -> Array:
    """OpenCV's distortion of normalised coordinates (..., 2) by (k1, k2, p1, p2, k3).

    The order of operations is OpenCV's, so that the results are the same to the last bit.
    """
    k1, k2, p1, p2, k3 = distortion
    x, y = normalised[..., 0], normalised[..., 1]
    r2 = x * x + y * y
    r4 = r2 * r2
    radial = 1 + k1 * r2 + k2 * r4 + k3 * (r4 * r2)
    xy, xx, yy = 2 * x * y, r2 + 2 * x * x, r2 + 2 * y * y
    return columns(x * radial + p1 * xy + p2 * xx, y * radial + p1 * yy + p2 * xy)


def undistort_normalised(normalised: Array, distortion: Sequence[float] | Array) -> Array:
    """The inverse of ``distort_normalised`` by five fixed-point steps, as in OpenCV.

    A point where the model folds back (negative radial factor) stays as it is.
    """
    k1, k2, p1, p2, k3 = distortion
    x0, y0 = normalised[..., 0], normalised[..., 1]
    x, y = x0, y0
    folded = np.zeros(x0.shape, bool)
    for _ in range(UNDISTORTION_STEPS):
        r2 = x * x + y * y
        inverse_radial = 1 / (1 + ((k3 * r2 + k2) * r2 + k1) * r2)
        folded |= inverse_radial < 0
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        x = np.where(folded, x0, (x0 - dx) * inverse_radial)
        y = np.where(folded, y0, (y0 - dy) * inverse_radial)
    return columns(x, y)


def distortion_terms(normalised: Array) -> Array:
    """Derivatives (..., 2, 5) of ``distort_normalised`` by its coefficients, in which it is linear.

    ``distort_normalised(xy, k) = xy + distortion_terms(xy) @ k`` but for rounding.
    """
    x, y = np.moveaxis(normalised, -1, 0)
    r2 = x**2 + y**2
    along_x = np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x**2, x * r2**3], axis=-1)
    along_y = np.stack([y * r2, y * r2**2, r2 + 2 * y**2, 2 * x * y, y * r2**3], axis=-1)
    return np.stack([along_x, along_y], axis=-2)
