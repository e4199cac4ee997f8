"""A folder in TUM layout that is still being written, read by polling its lists."""

from __future__ import annotations

import heapq
import logging
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import is_inside
from bmask_slam.graph.trajectory import Trajectory, check_seconds
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pairer
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.sequences.cameras import find_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import read_depth, read_rgb
from bmask_slam.sequences.lists import image_name

logger = logging.getLogger(__name__)

FINISHED = ".finished"
"""Name of the file by which a recorder says that the folder is complete."""
_FIRST_STAMPS = 5
"""Stamps at the beginning that are checked to be in seconds."""
_MAX_LINES = 5000
"""Largest number of lines of one list that wait for the other, which may be written in blocks."""


@dataclass(frozen=True)
class FollowOptions:
    """How long to wait for the recorder.

    Attributes:
        silence_s: the folder counts as complete when nothing new comes for so long.
        image_timeout_s: an image that cannot be read so long after it was listed is skipped.
        poll_s: interval of polling.
    """

    silence_s: float = 10.0
    image_timeout_s: float = 2.0
    poll_s: float = 0.02


class ListFollower:
    """Reads the lines of a growing list; a line without its line break is read later."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._position = 0
        self._rest = b""

    def new_lines(self, finished: bool) -> list[str]:
        """The lines since the last call; with ``finished``, a last one without a line break too."""
        try:
            with self.path.open("rb") as file:
                file.seek(self._position)
                data = file.read()
        except OSError as error:
            raise InputError(f"{self.path}: cannot be read any more ({error.strerror})") from error
        self._position += len(data)
        lines = (self._rest + data).split(b"\n")
        self._rest = b"" if finished else lines.pop()
        text = (line.decode("utf-8-sig", errors="replace").strip() for line in lines)
        return [line for line in text if line and not line.startswith("#")]


class _Image(NamedTuple):
    """An image that is listed; ``stream`` is RGB or DEPTH."""

    stamp_s: float
    stream: int
    path: Path


class _ListedPair(NamedTuple):
    """A pair of images that are to be read, and when they were listed."""

    stamp_s: float
    rgb: Path
    depth: Path
    lag_s: float
    listed_s: float


class GrowingFolder(MeasuredSource):
    """A folder in TUM layout that is read from its first line on while it is being written.

    It ends when a file ``.finished`` is there and everything is read, or when nothing new comes for
    ``silence_s``. Lines must be in the order of their stamps.

    Attributes:
        counts: images and lines that did not become frames so far.
        waits: False: frames that tracking has no time for are dropped, as with a camera.
    """

    pairs, waits = True, False

    def __init__(
        self, folder: Path, camera: Path | None = None, options: FollowOptions | None = None
    ) -> None:
        """Wait until the lists and the camera are there.

        Raises:
            InputError: there is no such folder, or they are missing for ``silence_s``.
        """
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder; make it before it is followed")
        self.name = folder.resolve().name
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self._folder, self._options = folder, options or FollowOptions()
        self._closed = threading.Event()
        self.camera, lists = self._await(camera)
        self._lists = [ListFollower(path) for path in lists]
        self._pairer = Pairer[Path](
            self.counts, lambda: self.camera.depth_time_offset_s, max_waiting=_MAX_LINES
        )
        self._first_s: list[float] = []

    def frames(self) -> Iterator[Frame]:
        """Each frame once both images can be read; unreadable ones are counted and skipped.

        Raises:
            InputError: the stamps are not in seconds.
        """
        waiting: deque[_ListedPair] = deque()
        index, heard_s, finished = 0, time.monotonic(), False
        while not (finished or self._closed.is_set()):
            silent = time.monotonic() - heard_s > self._options.silence_s
            finished = silent or (self._folder / FINISHED).exists()
            if listed := self._new_pairs(finished):
                waiting.extend(listed)
                heard_s = time.monotonic()
            image_timeout_s = 0.0 if finished else self._options.image_timeout_s
            while (
                waiting and (frame := self._load(waiting[0], index, image_timeout_s)) is not False
            ):
                waiting.popleft()
                index += 1
                if isinstance(frame, Frame):
                    yield frame
                heard_s = time.monotonic()
            if not finished:
                self._closed.wait(self._options.poll_s)

    def close(self) -> None:
        """End ``frames`` soon; may be called from any thread."""
        self._closed.set()

    def _await(self, given: Path | None) -> tuple[Camera, list[Path]]:
        deadline_s = time.monotonic() + self._options.silence_s
        while True:
            try:
                return find_camera(self._folder, given)[0], _find_lists(self._folder)
            except InputError:
                if time.monotonic() > deadline_s:
                    raise
            time.sleep(self._options.poll_s)

    def _new_pairs(self, finished: bool) -> list[_ListedPair]:
        """The pairs that are final by the lines since the last call."""
        listed_s = time.monotonic()
        kinds = (RGB, DEPTH) if len(self._lists) == 2 else (None,)
        new = [
            [image for line in each.new_lines(finished) for image in self._images(kind, line, each)]
            for kind, each in zip(kinds, self._lists, strict=True)
        ]
        pairs = []
        for stamp_s, stream, path in heapq.merge(*new, key=lambda image: image[0]):
            pairs += self._pairer.add(stream, stamp_s, path)
        if finished:
            pairs += self._pairer.finish()
        return [_ListedPair(*pair, listed_s) for pair in pairs]

    def _images(self, kind: int | None, line: str, listed: ListFollower) -> list[_Image]:
        """The images on a line; none of a broken line, which is counted.

        ``kind`` is the stream of the list; None where each line holds both.
        """
        columns = line.split() if kind is None else line.split(maxsplit=1)
        try:
            stamps_s = [float(text) for text in columns[::2]]
        except ValueError:
            stamps_s = [np.nan]
        files = columns[1::2]
        whole = len(columns) == (4 if kind is None else 2) and np.isfinite(stamps_s).all()
        if not whole or not all(map(is_inside, files)):
            self.counts.broken += 1
            logger.warning("%s: skipped the line %r", listed.path, line[:60])
            return []
        streams: tuple[int, ...] = (RGB, DEPTH)
        if kind is not None:
            streams = (kind,)
        elif files[0].startswith("depth") and files[1].startswith("rgb"):
            streams = (DEPTH, RGB)
        if RGB in streams:
            self._check_seconds(stamps_s[streams.index(RGB)], listed.path)
        paths = [listed.path.parent / file for file in files]
        return [_Image(*entry) for entry in zip(stamps_s, streams, paths, strict=True)]

    def _check_seconds(self, stamp_s: float, path: Path) -> None:
        if len(self._first_s) < _FIRST_STAMPS:
            self._first_s.append(stamp_s)
            if len(self._first_s) == _FIRST_STAMPS:
                check_seconds(np.sort(self._first_s), path)

    def _load(self, pair: _ListedPair, index: int, image_timeout_s: float) -> Frame | bool:
        """The frame; False if its images may still come, True if it is skipped and counted."""
        try:
            rgb = read_rgb(pair.rgb, self.camera)
            depth_m = read_depth(pair.depth, self.camera)
        except InputError as error:
            if time.monotonic() - pair.listed_s < image_timeout_s:
                return False
            self.counts.broken += 1
            logger.warning("skipped: %s", error)
            return True
        name = image_name(pair.rgb, self._folder)
        return Frame(index, pair.stamp_s, rgb, depth_m, name, pair.lag_s)


def _find_lists(folder: Path) -> list[Path]:
    """rgb.txt and depth.txt, or associations.txt."""
    both, one = [folder / "rgb.txt", folder / "depth.txt"], folder / "associations.txt"
    if all(path.is_file() for path in both):
        return both
    if one.is_file():
        return [one]
    raise InputError(
        f"{folder}: neither rgb.txt and depth.txt nor associations.txt; the recorder writes them"
    )
