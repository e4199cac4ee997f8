"""A bag as a recording: images in any order of asking, read from the bag as they are needed."""

from __future__ import annotations

import logging
import threading
import weakref
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.bags.bag_file import Bag, open_bag
from bmask_slam.sequences.bags.ros_images import colour_image, depth_image, stamp_s
from bmask_slam.sequences.bags.topics import find_camera, find_topics, split_path
from bmask_slam.sequences.lists import sorted_list
from bmask_slam.sequences.recording import Recording

logger = logging.getLogger(__name__)

KEPT_MESSAGES = 12
"""Messages that are kept in memory, for colour and depth images that come in another order."""
BEFORE_NS, AHEAD_NS = 200_000_000, 2_000_000_000
"""A new place is read from so long before; one that lies less ahead is reached by reading on."""
RGB, DEPTH = "rgb", "depth"


class _Place(NamedTuple):
    """Where a message is: its topic, its time of recording and its stamp."""

    topic: str
    time_ns: int
    stamp_s: float


def open_bag_recording(path: Path, camera: Path | Camera | None) -> Recording:
    """A bag, or a path with topics as ``BagTopics.of_path`` makes it.

    The bag is read once for the stamps in its messages, by which its images are sorted.

    Raises:
        InputError: a bag that cannot be read, no known topics, or no usable camera.
    """
    bag_path, requested = split_path(path)
    with open_bag(bag_path) as bag:
        topics = find_topics(bag, requested)
        found, form, lens = find_camera(bag, topics, camera)
        places: dict[str, list[_Place]] = {RGB: [], DEPTH: []}
        for name, time_ns, message in bag.records((topics.rgb, topics.depth)):
            kind = RGB if name == topics.rgb else DEPTH
            places[kind].append(_Place(name, time_ns, stamp_s(message.header)))
    source = "given" if camera is not None else f"{topics.camera_info} of {bag_path}"
    source += ", of undistorted images" if lens is not None else ""
    files = {kind: [path / kind / f"{p.stamp_s:.9f}" for p in places[kind]] for kind in places}
    lists = {
        kind: sorted_list(bag_path / kind, np.array([p.stamp_s for p in places[kind]]), files[kind])
        for kind in places
    }
    index: dict[Path, _Place] = {}
    for kind, found_places in places.items():
        for file, place in zip(files[kind], found_places, strict=True):
            index.setdefault(file, place)  # the first of those with one stamp, as in the list
    messages = _BagMessages(bag_path, index, (topics.rgb, topics.depth))
    logger.info("%s: colour on %s, depth on %s", bag_path, topics.rgb, topics.depth)
    return Recording(
        "ROS bag", path, lists[RGB], lists[DEPTH], found, source,
        form=form, colour=messages.colour, stored_depth=messages.depth, exists=index.__contains__,
        lens=lens,
    )  # fmt: skip


class _BagMessages:
    """The messages of two topics: read on where the next one is near, else from its place."""

    def __init__(self, path: Path, index: dict[Path, _Place], topics: tuple[str, ...]) -> None:
        self._path, self._index, self._topics = path, index, topics
        self._lock, self._open = threading.Lock(), ExitStack()
        weakref.finalize(self, self._open.close)
        self._bag: Bag | None = None
        self._stream: Iterator[tuple[str, int, Any]] = iter(())
        self._read_to_ns: int | None = None  # None: no stream is open
        self._kept: OrderedDict[_Place, Any] = OrderedDict()

    def colour(self, file: Path) -> Image:
        """A colour image (H, W, 3), red first. Raises InputError."""
        return colour_image(self._message(file), str(file)).copy()  # messages are read-only

    def depth(self, file: Path) -> NDArray:
        """Stored depth (h, w). Raises InputError."""
        return depth_image(self._message(file), str(file))

    def _message(self, file: Path) -> Any:
        place = self._index[file]
        with self._lock:
            if place not in self._kept:
                self._read_to(place)
            return self._kept[place]

    def _read_to(self, place: _Place) -> None:
        """Read on until a message is among the kept ones. Raises InputError if it is not there."""
        at_ns = self._read_to_ns
        if at_ns is None or not at_ns <= place.time_ns <= at_ns + AHEAD_NS:
            self._bag = self._bag or self._open.enter_context(open_bag(self._path))
            self._stream = self._bag.records(self._topics, place.time_ns - BEFORE_NS)
        for topic, time_ns, message in self._stream:
            self._read_to_ns = time_ns
            self._kept.setdefault(_Place(topic, time_ns, stamp_s(message.header)), message)
            while len(self._kept) > KEPT_MESSAGES:
                self._kept.popitem(last=False)
            if place in self._kept:
                return
            if time_ns > place.time_ns:
                break
        self._read_to_ns = None
        if place not in self._kept:
            raise InputError(f"{self._path}: no message of {place.stamp_s:.6f} s on {place.topic}")
