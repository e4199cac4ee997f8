"""BRISK keypoints with bucketing, depth and the pseudo-stereo coordinate, as arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from bmask_slam.features.fixed_size_descriptor import FixedSizeBrisk
from bmask_slam.features.keypoint_depth import sample_depth
from bmask_slam.graph.arrays import Array, Bits, Bytes, Floats, Image, Ints
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.frame import Frame

MAX_LAYERS = 4
FINEST_SIZE_PX = 12.0  # OpenCV's size of a BRISK keypoint in the finest layer
COVERED_MARGIN_PX = 8
"""Corners nearer to a covered part of the image are its border's, or show some of it."""


@dataclass(frozen=True)
class FeatureConfig:
    """The front end's parameters; pixels are those of the full image.

    Keypoints are found in the image and in images of half the size of the one before, as many
    layers as ``layer_shares`` has entries: shares of ``max_keypoints``. In the larger layers' place
    a smaller one has corners where the image is blurred, and for landmarks that come nearer. The
    corner threshold of a layer is the highest of ``thresholds`` at which FAST finds its share, so
    that a blurred frame still has enough keypoints and a frame with much texture takes no longer.
    In a dark image hardly a corner reaches the lowest: where fewer than ``few_corners`` do, the
    highest of ``faint_thresholds`` at which so many are found is used.
    Keypoints nearer to the border of their layer than ``border_px`` have no descriptor.
    ``pixel_sigma`` is the standard deviation of a BRISK keypoint at scale 1.
    ``disparity_sigma_px`` is a constant error of the depth's disparity, sigma_z = z^2 / bf *
    sigma_d, in place of what the camera says of its depth; None: the camera's own noise model.
    ``depth_window_px`` and ``depth_edge_ratio``: see sample_depth.
    """

    thresholds: tuple[int, ...] = (50, 35, 25, 18, 13, 9)
    faint_thresholds: tuple[int, ...] = (6, 4)
    few_corners: int = 200
    layer_shares: tuple[float, ...] = (1.0,)
    max_keypoints: int = 850
    bucket_px: int = 40
    border_px: int = 20
    pixel_sigma: float = 0.7
    disparity_sigma_px: float | None = None
    depth_window_px: int = 2
    depth_edge_ratio: float = 0.04
    min_depth_m: float = 0.3
    max_depth_m: float = 8.0

    def __post_init__(self) -> None:
        shares = self.layer_shares
        if not (1 <= len(shares) <= MAX_LAYERS and min(shares) > 0 and sum(shares) < 1.001):
            raise InputError(
                f"layer_shares {list(shares)}: give 1 to {MAX_LAYERS} positive shares of at most 1"
            )
        if not self.thresholds or self.bucket_px < 1:
            raise ValueError("thresholds must not be empty, bucket_px at least 1")
        if any(s is not None and s <= 0 for s in (self.pixel_sigma, self.disparity_sigma_px)):
            raise ValueError("pixel_sigma and disparity_sigma_px must be more than 0")


@dataclass(frozen=True)
class Features:
    """N keypoints of one frame.

    Attributes:
        pixels: (N, 2) undistorted (u, v).
        image_pixels: (N, 2) as detected in the image, for looking up pixels and masks.
        descriptors: (N, 8) uint64, the 512 bits of BRISK.
        scales: (N,) keypoint size relative to the finest layer, >= 1.
        angles_rad: (N,) BRISK's orientation in the image.
        depth_m: (N,) z-depth, NaN where missing or ambiguous.
        disparity_px: (N,) bf / z, NaN where depth is missing.
        sigmas_px: (N, 3) standard deviation of u, v and disparity.
        colours: (N, 3) uint8 red first.
        gray: (H, W) uint8, the image they come from.
    """

    pixels: Array
    image_pixels: Array
    descriptors: Bits
    scales: Array
    angles_rad: Array
    depth_m: Array
    disparity_px: Array
    sigmas_px: Array
    colours: Bytes
    gray: Image

    def __len__(self) -> int:
        return len(self.pixels)

    @property
    def measurements(self) -> Array:
        """(N, 3) of u, v and disparity in pixels; disparity NaN where depth is missing."""
        return np.column_stack([self.pixels, self.disparity_px])


class BriskExtractor:
    """Detects, buckets and describes. It holds OpenCV's detector: use one per thread."""

    def __init__(self, camera: Camera, config: FeatureConfig):
        self.camera = camera
        self.config = config
        self._depth_noise = camera.noise_of_depth(config.disparity_sigma_px)
        self._describer = FixedSizeBrisk(FINEST_SIZE_PX)
        self._border_px = max(config.border_px, self._describer.reach_px)
        self._visible: Bytes | None = None
        self.leave_out(camera)
        thresholds = (*config.thresholds, *config.faint_thresholds)
        self._fast = {t: cv2.FastFeatureDetector_create(t) for t in thresholds}

    def leave_out(self, camera: Camera) -> None:
        """Find nothing in what this camera says is covered."""
        seen = camera.visible(COVERED_MARGIN_PX) if camera.covered else None
        self._visible = None if seen is None else seen.astype(np.uint8)

    def extract(self, frame: Frame) -> Features:
        """The features of a frame. Pure: the same frame gives the same arrays."""
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        layer, scale, found = gray, 1.0, []
        for number, share in enumerate(self.config.layer_shares):
            if number:
                layer, scale = cv2.pyrDown(layer), 2 * scale
            enough = round(share * self.config.max_keypoints)
            pixels, response = self._corners(layer, enough)
            order = self._spread(pixels, response, layer.shape[1])[:enough]
            pixels = pixels[np.sort(order)]
            bits, angles_rad = self._describer.describe(layer, pixels)
            found.append(
                (scale * pixels.astype(float), np.full(len(bits), scale), angles_rad, bits)
            )
        *columns, descriptors = (np.concatenate(column) for column in zip(*found, strict=True))
        return self._assemble(frame, gray, (columns[0], columns[1], columns[2]), descriptors)

    def reserve(self, frame: Frame, features: Features, share: float) -> Features:
        """Further keypoints of a frame, best first, for a share of its features that is not used.

        They and the features of the full image are together what a search for so many more
        keypoints finds in it. Their descriptors are 0 until ``described``.
        """
        gray, width = features.gray, features.gray.shape[1]
        count = self.config.max_keypoints
        others = count - round(self.config.layer_shares[0] * count)
        enough = math.ceil(count / (1 - share)) - others
        pixels, response = self._corners(gray, enough)
        pixels = pixels[self._spread(pixels, response, width)[:enough]]
        own = features.image_pixels[features.scales == 1]
        places, known = ((p @ [1, width]).astype(np.int64) for p in (pixels, own))
        unknown = np.ones(gray.size, bool)
        unknown[known] = False
        raw = pixels[unknown[places]].astype(float)
        descriptors = np.zeros((len(raw), features.descriptors.shape[1]), np.uint64)
        return self._assemble(
            frame, gray, (raw, np.ones(len(raw)), np.zeros(len(raw))), descriptors
        )

    def at(self, frame: Frame, gray: Image, pixels: Array) -> tuple[Ints, Features]:
        """Keypoints where none were detected: of the pixels (N, 2) in view, and their rows."""
        reach, size = self._describer.reach_px, np.array(gray.shape[::-1])
        rows = np.flatnonzero(((pixels > reach) & (pixels < size - 1 - reach)).all(axis=1))
        if self._visible is not None:
            columns, lines = np.rint(pixels[rows]).astype(int).T
            rows = rows[self._visible[lines, columns] > 0]
        pixels, ones = pixels[rows], np.ones(len(rows))
        bits, angles_rad = self._describer.describe(gray, pixels.astype(np.float32))
        return rows, self._assemble(frame, gray, (pixels, ones, angles_rad), bits)

    def described(self, features: Features) -> Features:
        """Keypoints of a ``reserve`` with their descriptors and orientations."""
        found = self._describer.describe(features.gray, features.image_pixels.astype(np.float32))
        return replace(features, descriptors=found[0], angles_rad=found[1])

    def _corners(self, gray: Image, enough: int) -> tuple[Floats, Array]:
        """Pixels (N, 2) and responses (N,) at the highest threshold that gives enough.

        A corner's response is the highest threshold at which it is still found, so that one
        detection serves all thresholds above its own. Within a layer BRISK's detector is FAST
        with non-maximum suppression, and its sub-pixel step is not needed, since matches are
        registered to patches later.
        """
        inside = self._inside(gray)
        thresholds, few = self.config.thresholds, min(self.config.few_corners, enough)
        steps = [(thresholds[len(thresholds) // 2], enough), (thresholds[-1], few)]
        for lowest, needed in (*steps, *((t, few) for t in self.config.faint_thresholds)):
            found = self._fast[lowest].detect(gray, inside)
            if len(found) >= needed:
                break
        response = np.array([keypoint.response for keypoint in found])
        usable = (t for t in thresholds if t > lowest and (response >= t).sum() >= enough)
        threshold = next(usable, lowest)
        strong = response >= threshold
        pixels = np.reshape(cv2.KeyPoint_convert(found), (-1, 2)).astype(np.float32, copy=False)
        return pixels[strong], response[strong]

    def _inside(self, gray: Image) -> Bytes:
        """Mask (H, W): 255 where a descriptor can be computed, else 0."""
        border, (height, width) = self._border_px, gray.shape
        inside = np.zeros_like(gray)
        inside[border : height - border, border : width - border] = 255
        if self._visible is None:
            return inside
        return inside * cv2.resize(self._visible, (width, height), interpolation=cv2.INTER_NEAREST)

    def _spread(self, pixels: Floats, response: Array, width: int) -> Ints:
        """The order of keypoints (N, 2): every bucket's strongest, then the second, and so on."""
        size = self.config.bucket_px
        column, row = (pixels // size).astype(np.int64).T
        return spread_order(row * -(-width // size) + column, response)

    def _assemble(
        self,
        frame: Frame,
        gray: Image,
        keypoints: tuple[Array, Array, Array],
        descriptors: Bits,
    ) -> Features:
        """Features with depth and noise, from pixels (N, 2), scales (N,), angles (N,) in rad."""
        raw, scales, angles_rad = keypoints
        depth_m, spread_m = sample_depth(frame.depth_m, raw, self.config)
        disparity = self.camera.stereo_bf_px_m / depth_m
        sigmas = np.empty((len(raw), 3))
        sigmas[:, :2] = (self.config.pixel_sigma * np.sqrt(scales))[:, None]
        sensor = self.camera.stereo_bf_px_m * self._depth_noise.inverse_depth_sigma(1 / depth_m)
        depth_to_disparity = self.camera.stereo_bf_px_m / depth_m**2
        sigmas[:, 2] = np.hypot(sensor, depth_to_disparity * spread_m)
        rows, columns = np.rint(raw[:, 1]).astype(int), np.rint(raw[:, 0]).astype(int)
        return Features(
            pixels=self.camera.undistort(raw),
            image_pixels=raw,
            descriptors=descriptors,
            scales=scales,
            angles_rad=angles_rad,
            depth_m=depth_m,
            disparity_px=disparity,
            sigmas_px=sigmas,
            colours=frame.rgb[rows, columns],
            gray=gray,
        )


def select(features: Features, rows: Ints) -> Features:
    """Some of the keypoints, by their rows (M,)."""
    columns = {f.name: getattr(features, f.name) for f in fields(features)}
    return Features(**{n: a if n == "gray" else a[rows] for n, a in columns.items()})


def joined(first: Features, second: Features) -> Features:
    """Keypoints of one frame from two searches, concatenated."""
    names = [f.name for f in fields(first) if f.name != "gray"]
    pairs = {name: [getattr(first, name), getattr(second, name)] for name in names}
    return replace(first, **{name: np.concatenate(pair) for name, pair in pairs.items()})


def spread_order(bucket: Ints, score: Array) -> Ints:
    """Indices ordered by their rank inside their bucket, then by score, best first.

    A prefix of any length is spread over the buckets as evenly as they allow.
    """
    order = np.lexsort((-score, bucket))
    sorted_bucket = bucket[order]
    starts = np.flatnonzero(np.r_[True, sorted_bucket[1:] != sorted_bucket[:-1]])
    run_lengths = np.diff(np.r_[starts, len(order)])
    rank = np.arange(len(order)) - np.repeat(starts, run_lengths)
    return order[np.lexsort((-score[order], rank))]
