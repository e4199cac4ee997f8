"""Masks of keyframes from a process of their own: the newest keyframe first."""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import ImageToSegment, Masks, NotSegmented, Ready
from bmask_slam.live.processes.supervision import Patience, SupervisedWorker
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter

logger = logging.getLogger(__name__)

NICENESS = 15


WAITING = 4
"""Keyframes that wait for masks at most; the oldest are passed over."""


def serve_segmenter(
    channel: Channel, options: SegmenterOptions, sequence: Path, waiting: int
) -> None:
    """Segment images until the channel ends, the newest first, never more than these waiting."""
    os.nice(NICENESS)
    segmenter = make_segmenter(options, sequence, find_weights)
    channel.send(Ready(segmenter.labels.names))
    stack: list[ImageToSegment] = []
    while channel.open or stack:
        stack += channel.receive(0.0 if stack else 0.2)
        for late in stack[:-waiting]:
            channel.send(NotSegmented(late.keyframe_id, "newer keyframes came first"))
        stack = stack[-waiting:]
        if stack:
            image, started_s = stack.pop(), time.perf_counter()
            try:
                instances = segmenter.segment(image.rgb, image.name)
            except InputError as error:
                channel.send(NotSegmented(image.keyframe_id, str(error)))
                continue
            elapsed_ms = 1e3 * (time.perf_counter() - started_s)
            channel.send(Masks(image.keyframe_id, instances, elapsed_ms))


class RemoteSegmenter:
    """Gives keyframes' images to a process and collects their masks.

    Attributes:
        labels: what its numbers mean.
        dropped: keyframes that were passed over.
        segmentation_ms: time of each keyframe that was not.
    """

    def __init__(
        self, options: SegmenterOptions, sequence: Path, rules: Patience | None = None
    ) -> None:
        """Start it, and wait until it knows its labels. Raises InputError if it cannot start."""
        self.dropped = 0
        self.segmentation_ms: list[float] = []
        self._asked: dict[int, ImageToSegment] = {}
        target, arguments = f"{__name__}:serve_segmenter", (options, sequence, WAITING)
        self._worker = SupervisedWorker("segmenter", target, arguments, rules or Patience())
        self.labels = LabelSet(self._worker.first_words().labels)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._worker.pid

    @property
    def deaths(self) -> int:
        """How often the process died or hung."""
        return self._worker.deaths

    @property
    def waiting(self) -> int:
        """Keyframes whose masks have not come."""
        return len(self._asked)

    def awaits(self, keyframe_id: int) -> bool:
        """Whether the masks of a keyframe may still come."""
        return keyframe_id in self._asked

    def ask(self, image: ImageToSegment) -> None:
        """Ask for the masks of a keyframe; returns at once."""
        begins = not self._asked
        self._asked[image.keyframe_id] = image
        self._worker.send(image, begins)

    def answers(self) -> list[Masks]:
        """The masks that have come. A process that died or hangs is started again."""
        found = []
        for message in self._worker.receive():
            self._asked.pop(message.keyframe_id, None)
            match message:
                case Masks():
                    self.segmentation_ms.append(message.segmentation_ms)
                    found.append(message)
                case NotSegmented():
                    self.dropped += 1
                    logger.info("keyframe %d has no masks: %s", message.keyframe_id, message.reason)
        if self._worker.was_restarted(busy=bool(self._asked)):
            for image in self._asked.values():
                self._worker.send(image)
        if self._worker.given_up:
            self._asked.clear()
        return found

    def close(self) -> None:
        """End the process at once."""
        self._worker.close()
