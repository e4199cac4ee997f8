"""Corners of a square in an image to some hundredths of a pixel: where lines along its edges meet.

OpenCV's own refinements err inwards by a fifth of a pixel or more, alike at all four corners, which
would make every marker too far away.
"""

from __future__ import annotations

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image

_ALONG = np.linspace(0.12, 0.88, 20)
"""Where the edge is looked for on a side, which has length 1."""
_STEP_PX, _REACH_PX, _ROUNDS = 0.25, 3.0, 3
_MIN_CONTRAST = 8.0
_FAR_PX = 0.5
"""A point so far from the line of its edge is left out."""
_MIN_POINTS = 6


def refined_corners(gray: Image, corners: Array, modules: int) -> Array | None:
    """Corners (4, 2) of a black square on white, clockwise, from rough ones; None if it is unclear.

    Across each side the edge is the centre of the gradient; a line is fitted to those of a side.
    ``modules`` is the square's edge in modules, of which the outer ones are black.
    """
    rough, picture = corners, gray.astype(np.float32)
    for _ in range(_ROUNDS):
        sides = np.roll(corners, -1, axis=0) - corners
        lengths_px = np.linalg.norm(sides, axis=1)
        if lengths_px.min() < modules:
            return None
        reach_px = float(np.clip(0.8 * lengths_px.min() / modules, 1.0, _REACH_PX))
        normals = np.stack([sides[:, 1], -sides[:, 0]], axis=1) / lengths_px[:, None]
        offsets, known = _edges(picture, corners, (sides, normals), reach_px)
        fits = [_line(o[k], _ALONG[k]) for o, k in zip(offsets, known, strict=True)]
        if any(fit is None for fit in fits):
            return None
        ends = np.array([fit for fit in fits if fit is not None])  # offsets at both ends
        begin = corners + ends[:, :1] * normals
        end = corners + sides + ends[:, 1:] * normals
        corners = _meeting(begin, end)
    if not np.isfinite(corners).all() or np.abs(corners - rough).max() > _REACH_PX:
        return None
    return corners


def _edges(
    picture: Floats, corners: Array, axes: tuple[Array, Array], reach_px: float
) -> tuple[Array, Array]:
    """Offsets (4, N) of the edge along the outward normals, and which of them are clear."""
    sides, normals = axes
    across = np.arange(-reach_px, reach_px + _STEP_PX / 2, _STEP_PX)
    points = corners[:, None] + _ALONG[:, None] * sides[:, None]
    points = points[:, :, None] + across[:, None] * normals[:, None, None]
    u, v = (
        np.ascontiguousarray(points[..., k].reshape(-1, len(across)), np.float32) for k in (0, 1)
    )
    profile = cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rise = np.maximum(np.diff(profile.astype(float), axis=1), 0)
    total = rise.sum(axis=1)
    middle = (across[1:] + across[:-1]) / 2
    offsets = rise @ middle / np.maximum(total, 1e-9)
    known = total > _MIN_CONTRAST
    return offsets.reshape(4, -1), known.reshape(4, -1)


def _line(offsets: Array, along: Array) -> Array | None:
    """Offsets (2,) of a side's ends by those of its points (N,); None from too few points."""
    for _ in range(3):
        if len(offsets) < _MIN_POINTS:
            return None
        A = np.stack([1 - along, along], axis=1)
        ends = np.linalg.lstsq(A, offsets, rcond=None)[0]
        near = np.abs(A @ ends - offsets) < _FAR_PX
        if near.all():
            return np.asarray(ends)
        offsets, along = offsets[near], along[near]
    return None


def _meeting(begin: Array, end: Array) -> Array:
    """Where the line of each side (4, 2) to (4, 2) meets that of the side before it."""
    lines = np.cross(_homogeneous(begin), _homogeneous(end))
    points = np.cross(np.roll(lines, 1, axis=0), lines)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(points[:, :2] / points[:, 2:])


def _homogeneous(points: Array) -> Array:
    return np.column_stack([points, np.ones(len(points))])
