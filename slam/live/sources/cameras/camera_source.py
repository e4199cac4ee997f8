"""The base class of sources that read a connected camera, and how they find its intrinsics."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bmask_slam.graph.arrays import Array, Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.lens import distortion_terms
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.pairing import RGB, GapMeter, StreamClock
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.cameras import given_camera, read_camera
from bmask_slam.sequences.checks import check_depth_scale
from bmask_slam.sequences.frame import Frame

RETRY_S = 0.01
MAX_RESIDUAL_PX = 0.5
"""Largest error, over the image, of OpenCV's five distortion coefficients fitted to a device."""


class CameraImages(NamedTuple):
    """Colour (H, W, 3), red first, and registered depth (H, W) in metres, NaN where missing."""

    stamp_s: float
    rgb: Image
    depth_m: Floats


class CameraSource(MeasuredSource, ABC):
    """Reads a device until it is closed or gives no more frames.

    Attributes:
        counts: images that did not become frames so far.
        waits: False: frames that tracking has no time for are dropped.
    """

    camera: Camera
    waits = False

    def __init__(self, name: str, silence_s: float) -> None:
        self.name = name
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self._silence_s = silence_s
        self._failures: tuple[type[Exception], ...] = (RuntimeError,)  # as of bindings of C++
        self._closed = threading.Event()
        self._lock = threading.Lock()  # of the two that follow
        self._is_read = self._is_released = False

    def frames(self) -> Iterator[Frame]:
        """Each frame as soon as it is captured; the device is released at the end or by ``close``.

        Raises:
            InputError: none came for ``silence_s``, or the device's library failed.
        """
        gaps, index = GapMeter(self.counts), 0
        with self._lock:
            self._is_read = True
        try:
            for stamp_s, images in self._stamped():
                gaps.count(stamp_s)
                yield Frame(index, stamp_s, images.rgb, images.depth_m)
                index += 1
        finally:
            self._release_once()

    def _stamped(self) -> Iterator[tuple[float, CameraImages]]:
        """Images with the stamp on one clock; one that may be wrong waits for the next."""
        clock, heard_s = StreamClock(self.counts), time.monotonic()
        doubted: tuple[float, CameraImages] | None = None
        while not self._closed.is_set():
            images = self._captured()
            if images is None:
                if time.monotonic() - heard_s > self._silence_s:
                    if doubted is not None:
                        yield doubted
                    raise InputError(self._silence())
                self._closed.wait(RETRY_S)
                continue
            heard_s = time.monotonic()
            stamp_s = clock.map_stamp(RGB, images.stamp_s)
            if stamp_s is None:
                continue
            if doubted is not None and doubted[0] < stamp_s:
                yield doubted
            elif doubted is not None:
                self.counts.late += 1
            doubted = (stamp_s, images) if clock.doubts(RGB) else None
            if doubted is None:
                yield stamp_s, images
        if doubted is not None:  # of a recording, which ends with it
            yield doubted

    def close(self) -> None:
        """End ``frames`` soon, or release the device if they have not begun; from any thread."""
        self._closed.set()
        with self._lock:
            is_read = self._is_read
        if not is_read:
            self._release_once()

    def _release_once(self) -> None:
        with self._lock:
            is_released, self._is_released = self._is_released, True
        if not is_released:
            self._release()

    def _captured(self) -> CameraImages | None:
        try:
            return self._capture_images()
        except self._failures as error:
            reason = str(error) or type(error).__name__
            raise InputError(
                f"{self.name}: gives no more frames ({reason}); is the camera still plugged in?"
            ) from error

    @abstractmethod
    def _capture_images(self) -> CameraImages | None:
        """The next images, within a short time; None if there are none.

        Images without a partner are counted in ``counts``.
        """

    @abstractmethod
    def _release(self) -> None:
        """Release the device."""

    def _silence(self) -> str:
        plugged = "is the camera still plugged in?"
        return f"{self.name}: no frame for {self._silence_s:g} s; {plugged}"


def chosen_camera(given: Path | None, own: Camera, where: str) -> Camera:
    """The camera file that was given, what it leaves out or else all by the device's ``own``.

    Raises:
        InputError: a file with another depth scale than the device's; ``where`` names its depth.
    """
    if given is None:
        return own
    if is_preset(given):
        return given_camera(given, own)
    camera = read_camera(given)
    check_depth_scale(camera, own.depth_scale, str(given), where)
    return camera


def pixel_grid(width: int, height: int) -> Array:
    """Pixels (N, 2) all over an image."""
    steps = np.linspace(0.02, 0.98, 20)
    columns, rows = np.meshgrid(steps * width, steps * height)
    return np.column_stack([columns.ravel(), rows.ravel()])


def fit_distortion(camera: Camera, pixels: Array, rays: Array) -> Camera:
    """The camera with the distortion that projects ``rays`` to ``pixels``, by least squares.

    OpenCV's model is linear in k1, k2, p1, p2, k3 (``graph.camera.distortion_terms``).

    Args:
        pixels: (N, 2). rays: (N, 2) undistorted, at z = 1.

    Raises:
        InputError: the largest residual is too large, as for a fisheye lens.
    """
    terms = distortion_terms(rays)
    A = np.concatenate([camera.fx * terms[:, 0], camera.fy * terms[:, 1]])
    shift = pixels - (rays * [camera.fx, camera.fy] + [camera.cx, camera.cy])
    b = shift.T.ravel()
    solution = np.linalg.lstsq(A, b, rcond=None)[0]
    residual_px = float(np.abs(A @ solution - b).max())
    if residual_px > MAX_RESIDUAL_PX:
        raise InputError(
            f"the camera's distortion differs from OpenCV's by {residual_px:.1f} px; calibrate it "
            "and give --camera F"
        )
    k1, k2, p1, p2, k3 = (float(value) for value in solution)
    return Camera(
        camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy,
        (k1, k2, p1, p2, k3), camera.depth_scale, camera.fps,
    )  # fmt: skip
