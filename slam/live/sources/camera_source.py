"""What all cameras that are plugged in have in common."""

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
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.sequences.frame import Frame

RETRY_S = 0.01


class Shot(NamedTuple):
    """Colour (H, W, 3), red first, and registered depth (H, W) in metres, NaN where missing."""

    stamp_s: float
    rgb: Image
    depth_m: Floats


class CameraSource(ABC):
    """Takes what a device gives, as long as it gives something.

    Attributes:
        counts: what was left out so far.
        waits: False: what tracking has no time for is dropped.
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
        """Each frame as it comes; the device is released at the end.

        Raises:
            InputError: none came for ``silence_s``.
        """
        clock, gaps = StreamClock(self.counts), GapMeter(self.counts)
        index, heard_s = 0, time.monotonic()
        try:
            while not self._closed.is_set():
                shot = self._take()
                if shot is None:
                    self._check_silence(heard_s)
                    self._closed.wait(RETRY_S)
                    continue
                heard_s = time.monotonic()
                stamp_s = clock.place(RGB, shot.stamp_s)
                if stamp_s is not None:
                    gaps.count(stamp_s)
                    yield Frame(index, stamp_s, shot.rgb, shot.depth_m)
                    index += 1
        finally:
            self._release()

    def close(self) -> None:
        """Take no more; ``frames`` ends soon after."""
        self._closed.set()

    @abstractmethod
    def _take(self) -> Shot | None:
        """The next images, soon; None if there are none, or counted if they are not whole."""

    @abstractmethod
    def _release(self) -> None:
        """Let go of the device."""

    def _check_silence(self, heard_s: float) -> None:
        if time.monotonic() - heard_s > self._silence_s:
            raise InputError(
                f"{self.name}: no frame for {self._silence_s:g} s; is the camera still plugged in?"
            )
