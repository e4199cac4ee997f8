"""The protocol of a source of live frames, their pace, and what drops old frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, wait
from dataclasses import asdict, dataclass
from itertools import islice
from typing import Generic, Protocol, TypeVar

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.sequences.frame import Frame, reduced_frame
from bmask_slam.sequences.images import working_camera

T = TypeVar("T")

MAX_QUEUED = 16
"""Largest number of items that `Newest` queues; with one more, every second is dropped."""
MAX_AHEAD_S = 0.1
"""Longest interval in half of which ``paced`` sleeps before it reads the next frame."""
MAX_WAIT_S = 10.0
"""A longer pause in a recording is skipped."""


@dataclass
class SourceCounts:
    """What a source received that did not become a frame; counted as frames come.

    Attributes:
        unpaired_rgb, unpaired_depth: images without a partner near enough in time.
        duplicates: images with the stamp of the image before.
        late: images that came after one with a later stamp.
        clock_jumps: how often the clock was set back.
        gaps: steps between frames of more than three times the usual step.
        broken: images or list lines that could not be read.
        late_measurements, broken_measurements: of sensors beside the camera, from ROS 2: not later
            than the one before, or of another clock; and what was no measurement.
    """

    unpaired_rgb: int = 0
    unpaired_depth: int = 0
    duplicates: int = 0
    late: int = 0
    clock_jumps: int = 0
    gaps: int = 0
    broken: int = 0
    late_measurements: int = 0
    broken_measurements: int = 0

    def line(self) -> str:
        """The counts that are not zero, as text; empty if all are zero."""
        named = {name.replace("_", " "): count for name, count in asdict(self).items()}
        return ", ".join(f"{count} {name}" for name, count in named.items() if count)


class Source(Protocol):
    """A source of frames, live or recorded.

    Attributes:
        name: for titles.
        camera: of the frames.
        groundtruth: trajectory of the camera, where it is known.
        counts: what was received that did not become a frame.
        waits: True: each frame waits until the consumer asks for it, as in a recording that is
            played as fast as possible. False: frames come at their own rate, as a camera's do.
        pairs: whether images are paired by the camera's delay of depth.
        interpolates: whether depth is that at the colour image's time, by the camera's delay.
    """

    name: str
    camera: Camera
    groundtruth: Trajectory | None
    counts: SourceCounts
    waits: bool
    pairs: bool
    interpolates: bool

    def use(self, camera: Camera) -> None:
        """Give later frames their depth by another camera, from any thread."""

    def frames(self) -> Iterator[Frame]:
        """Frames in the order of their stamps, each as soon as it is available."""

    def close(self) -> None:
        """End ``frames`` soon, from any thread."""


class MeasuredSource:
    """A source that gives depth as it was measured, straightened by its camera."""

    camera: Camera
    pairs = interpolates = False

    def use(self, camera: Camera) -> None:
        """Straighten the depth of later frames by another camera, from any thread."""
        self.camera = camera


class Wrapped:
    """Another ``source``, of which something is changed."""

    def __init__(self, source: Source) -> None:
        self.name, self.camera = source.name, source.camera
        self.groundtruth = source.groundtruth
        self.counts, self.waits = source.counts, source.waits
        self.pairs, self.interpolates = source.pairs, source.interpolates
        self.source = source

    def use(self, camera: Camera) -> None:
        """Give later frames their depth by another camera."""
        self.source.use(camera)

    def close(self) -> None:
        """Close the other source."""
        self.source.close()


class Limited(Wrapped):
    """The first ``max_frames`` frames of another ``source``; all if that is None."""

    def __init__(self, source: Source, max_frames: int | None) -> None:
        super().__init__(source)
        self._max_frames = max_frames

    def frames(self) -> Iterator[Frame]:
        """Up to ``max_frames`` frames."""
        return islice(self.source.frames(), self._max_frames)


class Reduced(Wrapped):
    """Another ``source`` whose large images are reduced, as `images.working_camera` says."""

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.camera = working_camera(source.camera)

    def use(self, camera: Camera) -> None:
        """Give later frames their depth by another camera, of the reduced images."""
        self.camera = camera
        self.source.use(camera.recorded())

    def frames(self) -> Iterator[Frame]:
        """The source's frames, reduced."""
        for frame in self.source.frames():
            yield reduced_frame(frame, self.camera.reduced_by)


def paced(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Each frame at the time that its stamp gives, relative to the first, which comes at once.

    So does one after a long pause, and one with an earlier stamp than the one before.
    A frame is read in the second half of the interval before it is due, as a camera's driver would
    decode it, so that reading does not compete with the tracking of the frame before.
    """
    begin_s, last_s, interval_s = None, 0.0, 0.0
    while True:
        if begin_s is not None:
            _sleep_until(begin_s + last_s + min(interval_s, MAX_AHEAD_S) / 2)
        frame = next(frames, None)
        if frame is None:
            return
        now_s = time.monotonic()
        goes_back = frame.timestamp_s < last_s  # the last one was wrong
        if begin_s is None or goes_back or begin_s + frame.timestamp_s - now_s > MAX_WAIT_S:
            begin_s = now_s - frame.timestamp_s
        else:
            interval_s = frame.timestamp_s - last_s
        last_s = frame.timestamp_s
        _sleep_until(begin_s + last_s)
        yield frame


def _sleep_until(time_s: float) -> None:
    time.sleep(max(time_s - time.monotonic(), 0.0))


class Newest(Generic[T]):
    """Reads an iterator in a thread and queues its items for a consumer that may be too slow.

    Where more than ``keep`` wait, the consumer gets at most half of them, and at most ``keep``,
    spread evenly up to the newest: a stall of the consumer leaves no gap as long as itself, and
    little more delay than the queue holds.
    The thread is a daemon: a driver that does not return from a call does not keep the program.

    Attributes:
        dropped: items that the consumer did not get.
    """

    def __init__(self, items: Iterator[T], keep: int) -> None:
        self.dropped = 0
        self._items, self._keep = items, keep
        self._kept: list[T] = []
        self._stopped = False
        self._changed = threading.Condition()
        self._end: Future[None] = Future()
        self._end.add_done_callback(lambda _: self._notify())
        threading.Thread(target=self._read_all, name="source", daemon=True).start()

    def get(self, timeout_s: float) -> T | None:
        """The oldest item in the queue; None if none comes in that time, or at the end.

        Raises:
            Exception: what the iterator raised, after the items that it gave before.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._kept or self._end.done(), timeout_s)
            if self._kept:
                self._thin()
                return self._kept.pop(0)
        if self._end.done():
            self._end.result()
        return None

    @property
    def ended(self) -> bool:
        """Whether no item and no error will come any more."""
        with self._changed:
            return not self._kept and self._end.done() and self._end.exception() is None

    def stop(self, wait_s: float = 0.0) -> None:
        """Read no further item; waits so long for one that is being read."""
        self._stopped = True
        wait([self._end], wait_s)

    def _read_all(self) -> None:
        try:
            for item in self._items:
                if self._stopped:
                    break
                self._add(item)
        except BaseException as error:  # noqa: BLE001 - ``get`` raises it
            self._end.set_exception(error)
        else:
            self._end.set_result(None)

    def _add(self, item: T) -> None:
        with self._changed:
            self._kept.append(item)
            if len(self._kept) > MAX_QUEUED:
                self._drop_but(range(0, len(self._kept), 2))
            self._changed.notify()

    def _thin(self) -> None:
        """Drop items if too many wait."""
        waiting = len(self._kept)
        if waiting > self._keep:
            count = min(self._keep, waiting // 2)
            self._drop_but([(k + 1) * waiting // count - 1 for k in range(count)])

    def _drop_but(self, indices: Sequence[int]) -> None:
        self.dropped += len(self._kept) - len(indices)
        self._kept = [self._kept[k] for k in indices]

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify()
