"""Depth at keypoints: the median of a small window, or a plane fitted to a wide one.

There is none where a window straddles a depth edge. What tells an edge from noise is the noise that
the image itself has: cameras whose model is not known may have several times that of a Kinect.
"""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from bmask_slam.graph.arrays import Array, Floats

NOISE_STEP_PX, MIN_NOISE_WINDOWS, SMOOTH_SHARE = 48, 30, 0.1
SMOOTH_IQR_SIGMAS = 0.9  # lower decile of the interquartile range of 25 values of normal noise
RANGE_SIGMAS = 5.2  # 95 % of the ranges of 25 values of normal noise are smaller
VALUE_RADIUS_PX, RATE_RADIUS_PX = 6, 14
RATE_STEP_PX = 2
"""Every second pixel of the wide windows is used: depth errors of neighbours are correlated."""
MIN_WINDOW_SHARE = 0.6
MAX_STEP_SIGMAS = 4.0
"""A window shows one smooth surface if all pixels are within so many sensor sigmas of its plane."""


class DepthSampling(Protocol):
    """The part of `features.brisk.FeatureConfig` that is used here."""

    @property
    def depth_window_px(self) -> int:
        """Half the width of the window, less its middle."""

    @property
    def depth_edge_ratio(self) -> float:
        """Range of the window, as a share of the depth, from which on it may be an edge."""

    @property
    def min_depth_m(self) -> float:
        """A depth is larger,"""

    @property
    def max_depth_m(self) -> float:
        """and smaller than this."""


def sample_depth(depth_m: Floats, pixels: Array, config: DepthSampling) -> tuple[Array, Array]:
    """Depth (N,) at keypoints and its local spread (N,) in metres.

    The depth is the median of the valid pixels in a small window; the spread is half
    their interquartile range, so that slanted and rough surfaces are trusted less. Where the window
    straddles a depth edge (a range above ``depth_edge_ratio`` z, and above the noise's in this
    image) colour and depth disagree about which side the keypoint is on, and the depth is NaN.
    """
    median, spread, extent = _depth_windows(depth_m, pixels, config.depth_window_px)
    noise_m = _noise_per_m(depth_m, config.depth_window_px) * median**2
    good = (
        (median > config.min_depth_m)
        & (median < config.max_depth_m)
        & (extent < np.maximum(config.depth_edge_ratio * median, RANGE_SIGMAS * noise_m))
    )
    return np.where(good, median, np.nan), np.where(good, spread, np.nan)


def _depth_windows(depth_m: Floats, pixels: Array, radius: int) -> tuple[Array, Array, Array]:
    """Median, half the interquartile range and range (N,) of the windows around pixels, in metres.

    NaN where no more than half of a window is valid; missing depth is NaN or 0.
    """
    height, width = depth_m.shape
    offsets = np.arange(-radius, radius + 1)
    rows = np.clip(np.rint(pixels[:, 1]).astype(int)[:, None] + offsets, 0, height - 1)
    columns = np.clip(np.rint(pixels[:, 0]).astype(int)[:, None] + offsets, 0, width - 1)
    window = depth_m[rows[:, :, None], columns[:, None, :]].reshape(len(pixels), offsets.size**2)
    window = np.sort(np.where(window > 0, window, np.nan).astype(float), axis=1)  # NaN sorts last
    count = np.isfinite(window).sum(axis=1)
    window[count * 2 <= offsets.size**2] = np.nan
    index = np.arange(len(pixels))
    last = np.maximum(count - 1, 0)
    median = window[index, last // 2]
    spread = (window[index, (3 * last) // 4] - window[index, last // 4]) / 2
    return median, spread, window[index, last] - window[:, 0]


def _noise_per_m(depth_m: Floats, radius: int) -> float:
    """Noise c of the pixels of a depth image, sigma_z = c z^2, as of a disparity; 0 if unknown.

    By windows on a grid over the image, the smoothest tenth of which shows little but noise.
    """
    height, width = depth_m.shape
    v, u = np.mgrid[NOISE_STEP_PX // 2 : height : NOISE_STEP_PX, 0:width:NOISE_STEP_PX]
    median, spread, _ = _depth_windows(depth_m, np.column_stack([u.ravel(), v.ravel()]), radius)
    return _of_the_smoothest(2 * spread / median**2) / SMOOTH_IQR_SIGMAS


def _of_the_smoothest(spreads: Array) -> float:
    """The lower decile of the spreads (N,) of windows, NaN where unknown; 0 if few are known."""
    known = spreads[np.isfinite(spreads)]
    return float(np.quantile(known, SMOOTH_SHARE)) if len(known) >= MIN_NOISE_WINDOWS else 0.0


def smooth_value(image: Array, pixels: Array, sigmas: Array) -> tuple[Array, Array, Array]:
    """A plane fitted to an image around pixels (M, 2): value and slopes (M, 3), and rms (M,).

    NaN where few pixels are valid or one in the window is off the plane by ``max_step`` (M,), which
    is returned too: ``MAX_STEP_SIGMAS`` of these sigmas (M,), or of the noise that the image has.
    """
    values, offsets = _windows(image, pixels, VALUE_RADIUS_PX)
    plane, error = _fit_planes(values, offsets)
    rms = np.sqrt(np.nansum(error**2, axis=1) / error.shape[1])
    noise = _of_the_smoothest(np.where(np.isfinite(plane[:, 0]), rms / sigmas, np.nan))
    max_step = MAX_STEP_SIGMAS * max(1.0, noise) * sigmas
    smooth = np.nanmax(np.abs(error), axis=1, initial=0.0) < max_step
    return np.where(smooth[:, None], plane, np.nan), np.where(smooth, rms, np.nan), max_step


def mean_on_plane(
    change: Array, image: Array, pixels: Array, planes: Array, max_step: Array
) -> Array:
    """The change (M,) at pixels, fitted over wide windows where the image is on these planes."""
    values, offsets = _windows(change, pixels, RATE_RADIUS_PX, RATE_STEP_PX)
    around = _windows(image, pixels, RATE_RADIUS_PX, RATE_STEP_PX)[0]
    expected = planes[:, :1] + (offsets @ planes[:, 1:, None])[..., 0]
    values[~(np.abs(around - expected) < max_step[:, None])] = np.nan
    return _fit_planes(values, offsets)[0][:, 0]


def _windows(image: Array, pixels: Array, radius: int, step: int = 1) -> tuple[Array, Array]:
    """Values (M, n) in square windows around pixels (M, 2), and their offsets (M, n, 2)."""
    border = cv2.BORDER_CONSTANT
    padded = cv2.copyMakeBorder(image, radius, radius, radius, radius, border, value=float("nan"))
    dv, du = (d.ravel() for d in np.mgrid[: 2 * radius + 1 : step, : 2 * radius + 1 : step])
    nearest = np.clip(np.rint(pixels).astype(int), 0, np.array(image.shape[::-1]) - 1)
    values = padded[nearest[:, 1:] + dv, nearest[:, :1] + du]
    offsets = np.stack([du - radius, dv - radius], axis=1) + (nearest - pixels)[:, None]
    return values, offsets


def _fit_planes(values: Array, offsets: Array) -> tuple[Array, Array]:
    """Planes fitted to windows: value and slopes (M, 3), NaN with few values; errors (M, n)."""
    valid = np.isfinite(values)
    A = np.concatenate([np.ones((*values.shape, 1)), offsets], axis=2) * valid[..., None]
    H = A.swapaxes(1, 2) @ A + 1e-9 * np.eye(3)
    plane = np.linalg.solve(H, A.swapaxes(1, 2) @ np.nan_to_num(values)[..., None])
    error = values - (A @ plane)[..., 0]
    enough = valid.mean(axis=1) >= MIN_WINDOW_SHARE
    return np.where(enough[:, None], plane[..., 0], np.nan), error
