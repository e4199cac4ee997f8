"""Frames from a ROS bag, read message by message."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.message_frames import message_frames
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pair, Pairer
from bmask_slam.live.sources.source import MeasuredSource, SourceCounts, paced
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.bags.topics import BagTopics, find_camera, find_topics
from bmask_slam.sequences.frame import Frame


class BagSource(MeasuredSource):
    """A recorded bag; colour and depth are paired by the stamps in their headers.

    Attributes:
        counts: images that did not become frames so far.
        waits: see ``Source``; False if ``realtime``.
    """

    pairs = True

    def __init__(
        self,
        path: Path,
        topics: BagTopics | None = None,
        camera: Path | None = None,
        realtime: bool = False,
    ) -> None:
        """Find the topics and read the first message of each.

        Raises:
            InputError: a bag that cannot be read, a missing topic, messages that cannot be decoded
                as images, or no usable camera intrinsics.
        """
        self.name = path.resolve().stem
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.waits = not realtime
        self._path = path
        with open_bag(path) as bag:
            self._topics = find_topics(bag, topics or BagTopics())
            self._found = find_camera(bag, self._topics, camera)
        self.camera = self._found.camera

    def frames(self) -> Iterator[Frame]:
        """A frame of each pair of images; what cannot be decoded is counted and skipped."""
        return self._frames() if self.waits else paced(self._frames())

    def close(self) -> None:
        """Nothing to release: ``frames`` opens and closes the bag."""

    def _frames(self) -> Iterator[Frame]:
        names = (self._topics.rgb, self._topics.depth, str(self._path))
        return message_frames(self._pairs(), lambda: self.camera, self._found, self.counts, names)

    def _pairs(self) -> Iterator[Pair[Any]]:
        pairer = Pairer[Any](self.counts, lambda: self.camera.depth_time_offset_s)
        with open_bag(self._path) as bag:
            for name, message in bag.messages(self._topics.rgb, self._topics.depth):
                stream = RGB if name == self._topics.rgb else DEPTH
                yield from pairer.add(stream, stamp_s(message.header), message)
        yield from pairer.finish()
