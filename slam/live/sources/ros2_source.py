"""Frames from the topics of a running ROS 2, received over DDS without ROS."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.ros2.dds import LATCHED, SENSOR, STATE, Node, Reader
from bmask_slam.live.sources.message_frames import message_frames
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pair, Pairer
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts
from bmask_slam.sequences.bags.bag_file import INFO_TYPE, Topic
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.bags.topics import (
    TRANSFORMS,
    BagTopics,
    find_camera,
    find_topics,
)
from bmask_slam.sequences.frame import Frame

logger = logging.getLogger(__name__)

POLL_S = 0.002
EXPECTED_S = 2.0
"""Time in which a topic that has a publisher gives a message, before the camera is known."""


class _Heard:
    """What is heard on a domain, as ``topics`` reads a bag: topics, and first messages."""

    def __init__(self, node: Node, name: str) -> None:
        self.path = Path(name)
        self._node = node
        self._readers: dict[str, Reader] = {}
        self._messages: dict[str, list[Any]] = {}

    @property
    def topics(self) -> list[Topic]:
        """Those that have a publisher."""
        return sorted(Topic(name, kind, 1) for name, kind in self._node.published().items())

    def messages(self, *names: str) -> Iterator[tuple[str, Any]]:
        """The messages so far, after a wait for the first; none of what nobody publishes."""
        kinds = self._node.published()
        for name in names:
            if name in kinds:
                yield from ((name, message) for message in self._received(name, kinds[name]))

    def _received(self, name: str, kind: str) -> list[Any]:
        if name not in self._readers:
            quality = LATCHED._replace(depth=100) if name == TRANSFORMS else SENSOR
            self._readers[name] = self._node.reader(name, kind, quality)
        kept = self._messages.setdefault(name, [])
        end_s = time.monotonic() + EXPECTED_S
        while not kept and time.monotonic() < end_s:
            kept += self._readers[name].take()
            time.sleep(POLL_S)
        return kept


class Ros2Source(MeasuredSource):
    """Colour and depth images of a ROS 2 domain, paired by the stamps in their headers.

    A publisher may stop and start again; the topics are those of a known camera, or given.

    Attributes:
        counts: images that did not become frames so far.
        node: the participant, also for what is published.
    """

    waits = False

    def __init__(
        self,
        domain: int,
        topics: BagTopics,
        camera: Path | None,
        silence_s: float,
        reliable: bool = False,
    ) -> None:
        """Wait until somebody publishes the images and their camera.

        Raises:
            InputError: nobody does for ``silence_s``, or the camera cannot be used.
        """
        self.name = "ros2" if domain == 0 else f"ros2-{domain}"
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.node = Node(domain)
        self._silence_s = silence_s
        self._closed = threading.Event()
        self._where = f"ros2:{domain}"
        heard: Any = _Heard(self.node, self._where)
        self._topics = self._wait_for_topics(heard, topics)
        self.camera, self._form = find_camera(heard, self._topics, camera)
        kinds, quality = self.node.published(), STATE if reliable else SENSOR
        names = (self._topics.rgb, self._topics.depth)
        self._readers = [self.node.reader(name, kinds[name], quality) for name in names]
        logger.info("%s: colour on %s, depth on %s", self._where, *names)

    def frames(self) -> Iterator[Frame]:
        """A frame of each pair of images.

        Raises:
            InputError: none came for ``silence_s``.
        """
        names = (self._where,) * 3
        return message_frames(self._pairs(), lambda: self.camera, self._form, self.counts, names)

    def close(self) -> None:
        """End ``frames`` soon; may be called from any thread."""
        self._closed.set()

    def _pairs(self) -> Iterator[Pair[Any]]:
        pairer = Pairer[Any](self.counts, self.camera.depth_time_offset_s)
        heard_s = time.monotonic()
        broken = 0
        while not self._closed.is_set():
            found = []
            for stream, reader in ((RGB, self._readers[0]), (DEPTH, self._readers[1])):
                for message in reader.take():
                    found += pairer.add(stream, stamp_s(message.header), message)
            self.counts.broken += sum(reader.broken for reader in self._readers) - broken
            broken = sum(reader.broken for reader in self._readers)
            if found:
                heard_s = time.monotonic()
                yield from found
            elif time.monotonic() - heard_s > self._silence_s:
                raise InputError(
                    f"{self._where}: no frame for {self._silence_s:g} s; does {self._topics.rgb} "
                    "still have a publisher?"
                )
            else:
                self._closed.wait(POLL_S)
        yield from pairer.finish()

    def _wait_for_topics(self, heard: Any, topics: BagTopics) -> BagTopics:
        """The topics of the images and the camera_info, once they are published."""
        end_s = time.monotonic() + self._silence_s
        while True:
            try:
                found = find_topics(heard, topics)
                if self.node.published().get(found.camera_info) == INFO_TYPE:
                    return found
                if time.monotonic() > end_s:
                    return found  # what is missing is said where the camera is looked for
            except InputError:
                if time.monotonic() > end_s:
                    raise
            time.sleep(10 * POLL_S)
