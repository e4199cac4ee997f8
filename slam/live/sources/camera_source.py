"""The base class of sources that read a connected camera."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import NamedTuple

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.pairing import RGB, GapMeter, StreamClock
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.sequences.frame import Frame

RETRY_S = 0.01


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
        self._closed = threading.Event()

    def frames(self) -> Iterator[Frame]:
        """Each frame as soon as it is captured; the device is released at the end.

        Raises:
            InputError: none came for ``silence_s``.
        """
        clock, gaps = StreamClock(self.counts), GapMeter(self.counts)
        index, heard_s = 0, time.monotonic()
        try:
            while not self._closed.is_set():
                images = self._capture_images()
                if images is None:
                    self._check_silence(heard_s)
                    self._closed.wait(RETRY_S)
                    continue
                heard_s = time.monotonic()
                stamp_s = clock.map_stamp(RGB, images.stamp_s)
                if stamp_s is not None:
                    gaps.count(stamp_s)
                    yield Frame(index, stamp_s, images.rgb, images.depth_m)
                    index += 1
        finally:
            self._release()

    def close(self) -> None:
        """End ``frames`` soon; may be called from any thread."""
        self._closed.set()

    @abstractmethod
    def _capture_images(self) -> CameraImages | None:
        """The next images, within a short time; None if there are none.

        Images without a partner are counted in ``counts``.
        """

    @abstractmethod
    def _release(self) -> None:
        """Release the device."""

    def _check_silence(self, heard_s: float) -> None:
        if time.monotonic() - heard_s > self._silence_s:
            raise InputError(
                f"{self.name}: no frame for {self._silence_s:g} s; is the camera still plugged in?"
            )
