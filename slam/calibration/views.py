"""What self-calibration needs of a finished run: raw pixels, raw depths and how they change."""

from __future__ import annotations

import dataclasses
from collections import deque

import cv2
import numpy as np

from bmask_slam.calibration.motion import as_exposed
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.calibration.model import CalibrationViews
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_update import Observations
from bmask_slam.sequences import Sequence
from bmask_slam.sequences.images import SURFACE_STEP, read_depth
from bmask_slam.tracking.rolling_shutter import share_of_rows

MIN_VIEWS = 2
MIN_KEYFRAME_VIEWS = 12
VALUE_RADIUS_PX, RATE_RADIUS_PX = 6, 14
MIN_WINDOW_SHARE = 0.6
MAX_STEP_SIGMAS = 4.0
"""A window holds one smooth surface where no pixel is off its plane by more sensor sigmas."""
MAX_RATE_STEP_S = 0.2


def connected_views(tables: FactorTables, keyframe_ids: Ints, most: int) -> Observations:
    """Of these keyframes, the observations by which the largest connected set hangs together.

    Of more than ``most`` keyframes those with most observations are taken.
    Landmarks seen once and keyframes that see few others say nothing of the calibration. Loops and
    other relative poses are left out too: they were measured with the calibration in question.
    """
    table = tables.observations
    seen = table.select(table.all_rows())
    seen = seen.select(np.isin(seen.keyframe_ids, keyframe_ids))
    ids, count = np.unique(seen.keyframe_ids, return_counts=True)
    if len(ids) > most:
        richest = ids[np.argsort(-count, kind="stable")[:most]]
        seen = seen.select(np.isin(seen.keyframe_ids, richest))
    while True:
        views = np.unique(seen.landmark_ids, return_inverse=True, return_counts=True)
        keyframes = np.unique(seen.keyframe_ids, return_inverse=True, return_counts=True)
        keep = (views[2] >= MIN_VIEWS)[views[1]] & (keyframes[2] >= MIN_KEYFRAME_VIEWS)[
            keyframes[1]
        ]
        if keep.all():
            break
        seen = seen.select(keep)
    return seen.select(np.isin(seen.keyframe_ids, _largest_part(seen)))


def _largest_part(seen: Observations) -> list[int]:
    """Ids of the keyframes in the largest part that shared landmarks connect."""
    pairs = list(zip(seen.keyframe_ids.tolist(), seen.landmark_ids.tolist(), strict=True))
    landmarks_of: dict[int, list[int]] = {}
    keyframes_of: dict[int, list[int]] = {}
    for k, landmark in pairs:
        landmarks_of.setdefault(k, []).append(landmark)
        keyframes_of.setdefault(landmark, []).append(k)
    left, parts = set(landmarks_of), []
    while left:
        part, waiting = set(), deque([min(left)])
        while waiting:
            k = waiting.popleft()
            if k not in part:
                part.add(k)
                waiting.extend({n for i in landmarks_of[k] for n in keyframes_of[i]} - part)
        parts.append(sorted(part))
        left -= part
    return max(parts, key=len, default=[])


def make_views(
    seen: Observations,
    frames: dict[int, int],
    sequence: Sequence,
    motion: tuple[Array, Array],
) -> tuple[CalibrationViews, Ints, Ints]:
    """The views of a run, and the ids (K,) and (L,) of keyframes and landmarks.

    ``frames`` tells each keyframe's index in the sequence, whose camera must be the run's;
    ``motion`` is that of ``seen_motion``. Pixels are distorted and rolled again as the image is;
    depths are read anew from the raw depth images.

    Raises:
        InputError: a keyframe's depth image is missing or broken.
    """
    camera = sequence.camera
    keyframe_ids, keyframes = np.unique(seen.keyframe_ids, return_inverse=True)
    landmark_ids, landmarks = np.unique(seen.landmark_ids, return_inverse=True)
    pixels = camera.distort(as_exposed(seen.measurements[:, :2], motion, camera))
    inverse_depth, rms, rate = np.full((3, len(seen)), np.nan)
    lag_s = np.zeros(len(seen))
    # The graph's disparity sigma has the roughness of the surface in it, which is fitted here.
    nominal = float(np.nanmin(seen.sigmas_px[:, 2])) / camera.stereo_bf_px_m
    for k, keyframe in enumerate(keyframe_ids.tolist()):
        rows, index = np.flatnonzero(keyframes == k), frames[keyframe]
        image, limit = _raw_inverse_depth(sequence, index), MAX_STEP_SIGMAS * nominal
        planes, rms[rows] = smooth_value(image, pixels[rows], limit)
        inverse_depth[rows] = planes[:, 0]
        change, step_s = _change_around(sequence, index)
        rate[rows] = mean_on_plane(change, image, pixels[rows], planes, limit) / step_s
        lag_s[rows] = sequence.pairs.lags_s[index] - camera.depth_time_offset_s
    views = CalibrationViews(
        keyframes=keyframes,
        landmarks=landmarks,
        pixels=pixels,
        inverse_depth=inverse_depth,
        inverse_depth_rate=rate,
        lag_s=lag_s,
        sigma_px=seen.sigmas_px[:, 0],
        sigma_inverse=np.hypot(nominal, rms),
        shutter_velocity=share_of_rows(pixels[:, 1], camera)[:, None] * motion[1],
    )
    return views, keyframe_ids, landmark_ids


def _raw_inverse_depth(sequence: Sequence, index: int) -> Array:
    """Inverse depth (H, W) of a frame without the camera's offsets, NaN where missing."""
    camera = dataclasses.replace(sequence.camera, depth_offset_m=0.0)
    return 1.0 / read_depth(sequence.pairs.depth_files[index], camera).astype(float)


def _change_around(sequence: Sequence, index: int) -> tuple[Array, float]:
    """Change (H, W) of the inverse depth from the depth image before to the one after, and seconds.

    NaN where the surface changed, and everywhere when an image is missing or too far away.
    """
    before, after = max(index - 1, 0), min(index + 1, len(sequence) - 1)
    taken_s = sequence.pairs.timestamps_s + sequence.pairs.lags_s
    step_s = float(taken_s[after] - taken_s[before])
    first, last = (_raw_inverse_depth(sequence, i) for i in (before, after))
    change = last - first
    change[np.abs(change) > SURFACE_STEP * first] = np.nan
    if after - before < 2 or not 0 < step_s < MAX_RATE_STEP_S:
        change[:] = np.nan
    return change, step_s


def smooth_value(image: Array, pixels: Array, max_step: float) -> tuple[Array, Array]:
    """A plane fitted to an image around pixels (M, 2): value and slopes (M, 3), and rms (M,).

    NaN where too little is valid or something in the window is off the plane by ``max_step``.
    """
    values, offsets = _windows(image, pixels, VALUE_RADIUS_PX)
    plane, error = _fit_planes(values, offsets)
    smooth = np.nanmax(np.abs(error), axis=1, initial=0.0) < max_step
    rms = np.sqrt(np.nansum(error**2, axis=1) / error.shape[1])
    return np.where(smooth[:, None], plane, np.nan), np.where(smooth, rms, np.nan)


def mean_on_plane(
    change: Array, image: Array, pixels: Array, planes: Array, max_step: float
) -> Array:
    """The change (M,) at pixels of an image, over wide windows as far as it is on these planes."""
    values, offsets = _windows(change, pixels, RATE_RADIUS_PX)
    around = _windows(image, pixels, RATE_RADIUS_PX)[0]
    expected = planes[:, :1] + (offsets @ planes[:, 1:, None])[..., 0]
    values[~(np.abs(around - expected) < max_step)] = np.nan
    return _fit_planes(values, offsets)[0][:, 0]


def _windows(image: Array, pixels: Array, radius: int) -> tuple[Array, Array]:
    """Values (M, n) of square windows around pixels (M, 2), and where (M, n, 2) from these."""
    border = cv2.BORDER_CONSTANT
    padded = cv2.copyMakeBorder(image, radius, radius, radius, radius, border, value=float("nan"))
    dv, du = (d.ravel() for d in np.indices((2 * radius + 1, 2 * radius + 1)))
    nearest = np.clip(np.rint(pixels).astype(int), 0, np.array(image.shape[::-1]) - 1)
    values = padded[nearest[:, 1:] + dv, nearest[:, :1] + du]
    offsets = np.stack([du - radius, dv - radius], axis=1) + (nearest - pixels)[:, None]
    return values, offsets


def _fit_planes(values: Array, offsets: Array) -> tuple[Array, Array]:
    """Planes fitted to windows: value and slopes (M, 3), NaN with too little; errors (M, n)."""
    valid = np.isfinite(values)
    A = np.concatenate([np.ones((*values.shape, 1)), offsets], axis=2) * valid[..., None]
    H = A.swapaxes(1, 2) @ A + 1e-9 * np.eye(3)
    plane = np.linalg.solve(H, A.swapaxes(1, 2) @ np.nan_to_num(values)[..., None])
    error = values - (A @ plane)[..., 0]
    enough = valid.mean(axis=1) >= MIN_WINDOW_SHARE
    return np.where(enough[:, None], plane[..., 0], np.nan), error
