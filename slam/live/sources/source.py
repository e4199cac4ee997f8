"""Where live frames come from, and what happens to those that there is no time for."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from typing import Generic, Protocol, TypeVar

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.counts import SourceCounts
from bmask_slam.sequences import Sequence
from bmask_slam.sequences.frame import Frame

T = TypeVar("T")

MAX_AHEAD_S = 0.1
"""Of a longer pause in a recording no more is slept through before the next frame is read."""
MAX_WAIT_S = 10.0
"""A longer pause in a recording is not played."""


class Source(Protocol):
    """Frames that come when they come.

    Attributes:
        name: for titles. camera: of the frames. groundtruth: where there is one.
        counts: what was met that was no frame.
        waits: whether frames wait until they are taken, as in a recording; a camera's do not.
    """

    name: str
    camera: Camera
    groundtruth: Trajectory | None
    counts: SourceCounts
    waits: bool

    def frames(self) -> Iterator[Frame]:
        """Frames in the order of their stamps, each as soon as it is there."""

    def close(self) -> None:
        """End ``frames`` soon, from any thread."""


class RecordedSource:
    """A recorded sequence, at the speed of its stamps if ``realtime``."""

    def __init__(self, sequence: Sequence, realtime: bool, max_frames: int | None = None) -> None:
        self.name, self.camera = sequence.name, sequence.camera
        self.groundtruth = sequence.groundtruth
        self.counts = SourceCounts(
            unpaired_rgb=sequence.pairs.unpaired_rgb, unpaired_depth=sequence.pairs.unpaired_depth
        )
        self.waits = not realtime
        self._sequence, self._max_frames = sequence, max_frames

    def frames(self) -> Iterator[Frame]:
        """Each frame, not before its time; decoded ahead, as a camera's driver would."""
        frames = self._sequence.frames(0, self._max_frames)
        for frame in frames if self.waits else paced(frames):
            self.counts.broken = len(self._sequence.skipped)
            yield frame

    def close(self) -> None:
        """Nothing waits long."""


class Limited:
    """The first frames of another source."""

    def __init__(self, source: Source, max_frames: int | None) -> None:
        self.name, self.camera = source.name, source.camera
        self.groundtruth = source.groundtruth
        self.counts, self.waits = source.counts, source.waits
        self._source, self._max_frames = source, max_frames

    def frames(self) -> Iterator[Frame]:
        """Up to ``max_frames``; all if that is None."""
        return islice(self._source.frames(), self._max_frames)

    def close(self) -> None:
        """Close the other."""
        self._source.close()


def paced(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Each frame, not before its time by the stamps; the first at once.

    It is read in the second half of the time until then, as a camera would deliver it, and not
    while the frame before is tracked.
    """
    begin_s, last_s, interval_s = None, 0.0, 0.0
    while True:
        if begin_s is not None:
            _sleep_until(begin_s + last_s + min(interval_s, MAX_AHEAD_S) / 2)
        frame = next(frames, None)
        if frame is None:
            return
        now_s = time.monotonic()
        if begin_s is None or begin_s + frame.timestamp_s - now_s > MAX_WAIT_S:
            begin_s = now_s - frame.timestamp_s
        else:
            interval_s = frame.timestamp_s - last_s
        last_s = frame.timestamp_s
        _sleep_until(begin_s + last_s)
        yield frame


def _sleep_until(time_s: float) -> None:
    time.sleep(max(time_s - time.monotonic(), 0.0))


class Newest(Generic[T]):
    """Takes items from an iterator in a thread and keeps a few; one too many drives out the others.

    So a short stall costs no item, and a lasting one no more delay than a short one.

    Attributes:
        dropped: items that nobody took in time.
    """

    def __init__(self, items: Iterator[T], keep: int) -> None:
        self.dropped = 0
        self._items, self._keep = items, keep
        self._kept: list[T] = []
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="source")
        self._end = self._thread.submit(self._take)
        self._end.add_done_callback(lambda _: self._notify())

    def get(self, timeout_s: float) -> T | None:
        """The oldest item kept; None if none comes in that time, or at the end.

        Raises what the iterator raised, after the items that came before.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._kept or self._end.done(), timeout_s)
            if self._kept:
                return self._kept.pop(0)
        if self._end.done():
            self._end.result()
        return None

    @property
    def ended(self) -> bool:
        """Whether nothing more will come, not even an error."""
        with self._changed:
            return not self._kept and self._end.done() and self._end.exception() is None

    def stop(self) -> None:
        """Take no more."""
        self._stopped = True
        self._thread.shutdown(wait=False)

    def _take(self) -> None:
        for item in self._items:
            if self._stopped:
                return
            with self._changed:
                self._kept.append(item)
                if len(self._kept) > self._keep:
                    self.dropped += len(self._kept) - 1
                    del self._kept[:-1]
                self._changed.notify()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify()
