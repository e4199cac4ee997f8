"""Frames from a ROS bag, read message by message."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pair, Pairer
from bmask_slam.live.sources.source import SourceCounts, paced
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.bags.ros_images import colour_image, depth_image, stamp_s
from bmask_slam.sequences.bags.topics import BagTopics, find_camera, find_topics
from bmask_slam.sequences.checks import check_sizes
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import depth_in_metres

logger = logging.getLogger(__name__)


class BagSource:
    """A recorded bag; colour and depth are paired by the stamps in their headers.

    Attributes:
        counts: images that did not become frames so far.
        waits: see ``Source``; False if ``realtime``.
    """

    use = None

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
            self.camera, self._form = find_camera(bag, self._topics, camera)

    def frames(self) -> Iterator[Frame]:
        """A frame of each pair of images; what cannot be decoded is counted and skipped."""
        return self._frames() if self.waits else paced(self._frames())

    def close(self) -> None:
        """Nothing to release: ``frames`` opens and closes the bag."""

    def _frames(self) -> Iterator[Frame]:
        index = 0
        for pair in self._pairs():
            try:
                rgb = colour_image(pair.rgb, f"{self._topics.rgb} at {pair.stamp_s:.6f}")
                stored = depth_image(pair.depth, f"{self._topics.depth} at {pair.stamp_s:.6f}")
                where = f"{self._path} at {pair.stamp_s:.6f}"
                check_sizes(rgb, stored, self.camera, where, self._form.camera)
            except InputError as error:
                self.counts.broken += 1
                logger.warning("skipped: %s", error)
                continue
            depth_m = depth_in_metres(self._form.on_colour(stored, self.camera), self.camera)
            yield Frame(index, pair.stamp_s, rgb, depth_m, depth_lag_s=pair.lag_s)
            index += 1

    def _pairs(self) -> Iterator[Pair[Any]]:
        pairer = Pairer[Any](self.counts, self.camera.depth_time_offset_s)
        with open_bag(self._path) as bag:
            for name, message in bag.messages(self._topics.rgb, self._topics.depth):
                stream = RGB if name == self._topics.rgb else DEPTH
                yield from pairer.add(stream, stamp_s(message.header), message)
        yield from pairer.finish()
