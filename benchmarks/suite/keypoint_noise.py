"""Accuracy of keypoints and depth against the exact truth of a rendered sequence.

    bmask-slam render office --frames 300 --true-depth --out office
    python -m benchmarks.suite.keypoint_noise office [--json]

A keypoint of one frame, with the noise-free depth there, is a point whose true place in a later
frame follows from the true poses. Compared with it: the BRISK keypoint that matches it there, and
that keypoint after registration to the patch around the first one
(slam/features/patch_alignment.py). Likewise
the disparity bf/z that the front end reads from the noisy depth, against the true one.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.features.brisk import BriskExtractor, FeatureConfig, Features
from bmask_slam.features.matching import MatchConfig, WindowIndex, match_pairs
from bmask_slam.features.patch_alignment import SubpixelConfig, cut_patches, register_patches
from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.graph.trajectory import associate_stamps
from bmask_slam.sequences.sequence import Sequence, open_sequence

GAPS = (1, 5, 15)
STEP = 10
WINDOW_PX = 6.0
DEPTH_BANDS_M = ((0.5, 2.0), (2.0, 3.0), (3.0, 5.0))
FLAT_SHARE = 0.01


@dataclass(frozen=True)
class KeypointNoise:
    """Errors along u and v, in pixels, of matches ``gap`` frames apart.

    Sigmas are robust, 1.4826 times the median absolute error; ``registered_share`` is of the
    matches, and both sigmas are over the registered ones; ``brisk_all_px`` is over all.
    """

    gap: int
    matches: int
    registered_share: float
    brisk_all_px: float
    brisk_px: float
    registered_px: float


@dataclass(frozen=True)
class DisparityNoise:
    """Errors in pixels of the disparity bf/z of keypoints between two depths."""

    from_m: float
    to_m: float
    keypoints: int
    sigma_px: float
    median_px: float


@dataclass(frozen=True)
class _View:
    """One frame: its features, noise-free depth (H, W) in metres and pose T_world_camera."""

    features: Features
    true_depth_m: Array
    T_world_camera: Array


def robust_sigma(errors: Array) -> float:
    """Standard deviation of normal errors with zero mean, from their median size."""
    return float(1.4826 * np.median(np.abs(errors))) if errors.size else float("nan")


def true_depth_at(depth_m: Array, pixels: Array) -> Array:
    """Noise-free depth (N,) at pixels (N, 2), linear in 1/z; NaN at edges and outside."""
    column, row = np.floor(pixels).astype(int).T
    a, b = (pixels - np.floor(pixels)).T
    height, width = depth_m.shape
    inside = (column >= 0) & (row >= 0) & (column < width - 1) & (row < height - 1)
    column, row = np.where(inside, column, 0), np.where(inside, row, 0)
    corners = [depth_m[row + i, column + j] for i in (0, 1) for j in (0, 1)]
    top = (1 - a) / corners[0] + a / corners[1]
    bottom = (1 - a) / corners[2] + a / corners[3]
    depth = 1 / ((1 - b) * top + b * bottom)
    smooth = np.ptp(corners, axis=0) < FLAT_SHARE * depth
    return np.where(inside & smooth, depth, np.nan)


def true_pixels(first: _View, second: _View, camera: Camera) -> tuple[Ints, Array, Array]:
    """The first view's keypoints visible in the second: rows, pixels (N, 2), zooms (N,).

    A point counts as visible if the second view's noise-free depth there agrees with it.
    """
    pixels = first.features.image_pixels
    depth_m = true_depth_at(first.true_depth_m, pixels)
    known = np.flatnonzero(np.isfinite(depth_m))
    points = camera.backproject(pixels[known], depth_m[known])
    T_second_first = inverse(second.T_world_camera) @ first.T_world_camera
    points = transform(T_second_first, points)
    front = points[:, 2] > 0.1
    known, points = known[front], points[front]
    places = camera.project(points)
    there_m = true_depth_at(second.true_depth_m, places)
    visible = np.abs(there_m - points[:, 2]) < FLAT_SHARE * points[:, 2]
    return known[visible], places[visible], (depth_m[known] / points[:, 2])[visible]


def match_errors(first: _View, second: _View, camera: Camera) -> tuple[Array, Array, Array]:
    """Errors (M, 2) of BRISK, (M, 2) after registration, and (M,) whether that counts."""
    rows, truth, zooms = true_pixels(first, second, camera)
    pairs = WindowIndex(second.features.image_pixels).pairs(truth, np.full(len(truth), WINDOW_PX))
    tables = (first.features.descriptors[rows], second.features.descriptors)
    matches = match_pairs(pairs, tables, MatchConfig())
    rows, truth, zooms = rows[matches.query], truth[matches.query], zooms[matches.query]
    start = second.features.image_pixels[matches.train]
    patches = cut_patches(first.features.gray, first.features.image_pixels[rows])
    config = SubpixelConfig()
    moved, correlation = register_patches(
        second.features.gray, start, patches, config.iterations, zooms
    )
    limit = config.max_shift_px * np.sqrt(second.features.scales[matches.train])
    shift = np.linalg.norm(moved - start, axis=1)
    good = (correlation > config.min_correlation) & (shift < limit)
    return start - truth, moved - truth, good


def load_view(sequence: Sequence, extractor: BriskExtractor, index: int) -> _View:
    """A frame with the truth about it."""
    frame, truth = sequence.load(index), sequence.groundtruth
    assert truth is not None
    path = sequence.folder / "depth_true" / sequence.pairs.depth_files[index].name
    stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if stored is None:
        raise SystemExit(f"error: {path}: no such image; render the sequence with --true-depth")
    depth_m = np.where(stored > 0, stored / sequence.camera.depth_scale, np.nan)
    _, (row,) = associate_stamps(np.array([frame.timestamp_s]), truth.timestamps_s)
    return _View(extractor.extract(frame), depth_m, truth.poses_world_camera[row])


def keypoint_noise(folder: Path) -> list[KeypointNoise]:
    """Statistics for every gap, over pairs of frames spread along the sequence."""
    sequence = open_sequence(folder)
    extractor = BriskExtractor(sequence.camera, FeatureConfig())
    results = []
    for gap in GAPS:
        parts = []
        for index in range(0, len(sequence) - gap, STEP):
            views = [load_view(sequence, extractor, i) for i in (index, index + gap)]
            parts.append(match_errors(views[0], views[1], sequence.camera))
        brisk, moved, good = (np.concatenate(column) for column in zip(*parts, strict=True))
        sigmas = [robust_sigma(errors) for errors in (brisk, brisk[good], moved[good])]
        results.append(KeypointNoise(gap, len(good), float(good.mean()), *sigmas))
    return results


def disparity_noise(folder: Path) -> list[DisparityNoise]:
    """Statistics of the front end's disparities in bands of depth."""
    sequence = open_sequence(folder)
    extractor = BriskExtractor(sequence.camera, FeatureConfig())
    truths, errors = [], []
    for index in range(0, len(sequence), STEP):
        view = load_view(sequence, extractor, index)
        true_m = true_depth_at(view.true_depth_m, view.features.image_pixels)
        known = np.isfinite(true_m) & np.isfinite(view.features.disparity_px)
        truths.append(true_m[known])
        bf = sequence.camera.stereo_bf_px_m
        errors.append(view.features.disparity_px[known] - bf / true_m[known])
    true_m, error_px = np.concatenate(truths), np.concatenate(errors)
    results = []
    for low, high in DEPTH_BANDS_M:
        band = error_px[(true_m >= low) & (true_m < high)]
        median = float(np.median(band)) if len(band) else float("nan")
        results.append(DisparityNoise(low, high, len(band), robust_sigma(band), median))
    return results


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path, help="rendered with --true-depth")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    rows = {
        "keypoints": [asdict(row) for row in keypoint_noise(arguments.sequence)],
        "disparity": [asdict(row) for row in disparity_noise(arguments.sequence)],
    }
    if arguments.json:
        print(json.dumps(rows))
        return
    for kind, table in rows.items():
        print(kind)
        for row in table:
            print("  " + "  ".join(f"{key} {value:.4g}" for key, value in row.items()))


if __name__ == "__main__":
    main()
