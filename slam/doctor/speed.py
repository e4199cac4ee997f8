"""How fast this machine is: corners, tracking, iSAM2 and the network on images made here."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
DEPTH_M, STEP_PX = 2.0, 12
FRAMES, REPEATS, NETWORK_REPEATS = 45, 9, 3
RATE_HZ = 30.0
REAL = 1.8
"""Frames of real rooms take about so much longer than those of a wall that passes by: measured on
freiburg1_rpy (1.9) and the rendered office (1.5 to 1.9) beside this, 2026-11-24."""
KEYFRAME_SHARE = 0.2
"""Of a hand-held camera one frame in five becomes a keyframe, about; in fast turns one in three."""
KEYFRAMES_HZ = 2.0
"""Of a hand-held camera, about: what the network has to keep up with."""


@dataclass(frozen=True)
class Speed:
    """Median times in milliseconds; NaN where it was not measured.

    Attributes:
        orb_ms, brisk_ms: OpenCV's corners and descriptors of an image of 640x480 pixels.
        features_ms: this program's BRISK features.
        frame_ms: a tracked frame of the whole system.
        keyframe_ms: a frame that becomes a keyframe, with map, graph and loops.
        isam2_ms: the graph's part of a keyframe.
        network_ms: the light network on an image.
    """

    orb_ms: float
    brisk_ms: float
    features_ms: float
    frame_ms: float
    keyframe_ms: float
    isam2_ms: float
    network_ms: float

    def expectations(self) -> list[str]:
        """What that means for a camera of 640x480 pixels at 30 Hz, in plain words."""
        rate_hz = 1e3 / (REAL * self.frame_ms)
        run_ms = REAL * (self.frame_ms + KEYFRAME_SHARE * self.keyframe_ms)
        minutes = 60 * RATE_HZ * run_ms / 6e4
        live = "a camera at 30 Hz is tracked frame by frame"
        if rate_hz < 1.1 * RATE_HZ:
            live = f"of a camera at 30 Hz about {min(rate_hz, RATE_HZ):.0f} frames a second"
            live += ": set the camera to 15 Hz, or --set features.max_keypoints=500"
        told = [
            f"live: {live}",
            f"run: a minute of recording takes about {minutes:.1f} minutes without a network",
        ]
        if np.isnan(self.network_ms):
            return [*told, "labels: not measured, see the extra semantics"]
        if self.network_ms * KEYFRAMES_HZ < 1e3:
            return [*told, f"labels: {1e3 / self.network_ms:.1f} images a second, enough to follow"]
        return [*told, "labels: the network falls behind a moving camera; --segmenter none, --ray"]


def measure_speed(network: bool) -> Speed:
    """Measure in a second or two, with ``network`` in a few more."""
    texture = _texture()
    image = np.ascontiguousarray(texture[:, : CAMERA.width])
    features_ms, frame_ms, keyframe_ms, isam2_ms = _system_ms(texture)
    return Speed(
        orb_ms=_median_ms(_detector(cv2.ORB_create(1000), image), REPEATS),
        brisk_ms=_median_ms(_detector(cv2.BRISK_create(30), image), REPEATS),
        features_ms=features_ms,
        frame_ms=frame_ms,
        keyframe_ms=keyframe_ms,
        isam2_ms=isam2_ms,
        network_ms=_network_ms(np.repeat(image[..., None], 3, axis=2)) if network else np.nan,
    )


def _texture() -> Image:
    """A grey strip (480, 640 + what the camera passes) of noise at several scales."""
    width = CAMERA.width + STEP_PX * FRAMES
    rng = np.random.default_rng(3)
    total = np.zeros((CAMERA.height, width), np.float32)
    for sigma, weight in ((1.5, 1.0), (4.0, 2.0), (12.0, 3.0)):
        noise = rng.normal(size=total.shape).astype(np.float32)
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), sigma), np.float32)
        total += weight * noise / noise.std()
    return np.clip(128 + 22 * total, 0, 255).astype(np.uint8)


def _system_ms(texture: Image) -> tuple[float, float, float, float]:
    """Medians of features, frames, keyframes, and of their graph, on a wall that passes by."""
    system = SlamSystem(CAMERA)
    depth_m = np.full((CAMERA.height, CAMERA.width), DEPTH_M, np.float32)
    features_ms, frames_ms, keyframes_ms, graph_ms = [], [], [], []
    for k in range(FRAMES):
        gray = texture[:, STEP_PX * k : STEP_PX * k + CAMERA.width]
        frame = Frame(k, k / RATE_HZ, np.repeat(gray[..., None], 3, axis=2), depth_m)
        started_s = time.perf_counter()
        result = system.process(frame)
        took_ms = 1e3 * (time.perf_counter() - started_s)
        features_ms.append(result.stage_ms["features"])
        if "graph" in result.stage_ms:
            graph_ms.append(result.stage_ms["graph"])
            keyframes_ms.append(took_ms)
        elif k:
            frames_ms.append(took_ms)
    return (
        float(np.median(features_ms)),
        float(np.median(frames_ms)),
        float(np.median(keyframes_ms[1:])),  # the first one loads libraries
        float(np.median(graph_ms[1:])),
    )


def _detector(detector: Any, image: Image) -> Callable[[], object]:
    return lambda: detector.detectAndCompute(image, None)


def _network_ms(rgb: Image) -> float:
    """The light network's time for an image; NaN if it cannot be loaded."""
    try:
        segmenter = make_segmenter(SegmenterOptions(), Path())
    except InputError:
        return float("nan")
    return _median_ms(lambda: segmenter.segment(rgb, ""), NETWORK_REPEATS)


def _median_ms(call: Callable[[], object], repeats: int) -> float:
    """The median of some calls, after one that is not counted."""
    call()
    times_ms = []
    for _ in range(repeats):
        started_s = time.perf_counter()
        call()
        times_ms.append(1e3 * (time.perf_counter() - started_s))
    return float(np.median(times_ms))
