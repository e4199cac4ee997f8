"""Masks of keyframes from a process of their own: the newest keyframe first."""

from __future__ import annotations

import logging
import os
import time
from dataclasses import dataclass
from pathlib import Path

from graph.errors import InputError
from semantics.labels import LabelSet
from semantics.segmenter_table import SegmenterOptions, make_segmenter
from slam.live.channel import Channel
from slam.live.messages import ImageToSegment, Masks, NotSegmented, Ready
from slam.live.worker import Failure, Worker

logger = logging.getLogger(__name__)

NICENESS = 15


@dataclass(frozen=True)
class SegmentationConfig:
    """At most ``waiting`` keyframes wait for masks, the oldest are passed over.

    A process that has not answered for ``patience_s`` hangs and is started again, at most
    ``restarts`` times; ``start_s`` is how long it may take to start.
    """

    waiting: int = 4
    patience_s: float = 20.0
    start_s: float = 60.0
    restarts: int = 3


def serve_segmenter(
    channel: Channel, options: SegmenterOptions, sequence: Path, waiting: int
) -> None:
    """Segment images until the channel ends, the newest first, never more than these waiting."""
    os.nice(NICENESS)
    segmenter = make_segmenter(options, sequence)
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
        deaths: how often the process died or hung.
    """

    def __init__(
        self, options: SegmenterOptions, sequence: Path, config: SegmentationConfig | None = None
    ) -> None:
        """Start it, and wait until it knows its labels. Raises InputError if it cannot start."""
        self.config = config or SegmentationConfig()
        self.dropped = self.deaths = 0
        self.segmentation_ms: list[float] = []
        self._arguments = (options, sequence, self.config.waiting)
        self._asked: dict[int, ImageToSegment] = {}
        self._heard_s = time.monotonic()
        self._worker = self._start()
        self.labels = LabelSet(self._first_words())

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._worker.pid

    @property
    def waiting(self) -> int:
        """Keyframes whose masks have not come."""
        return len(self._asked)

    def ask(self, image: ImageToSegment) -> None:
        """Ask for the masks of a keyframe; returns at once."""
        if not self._asked:
            self._heard_s = time.monotonic()
        self._asked[image.keyframe_id] = image
        self._worker.send(image)

    def answers(self) -> list[Masks]:
        """The masks that have come. A process that died or hangs is started again."""
        found = []
        for message in self._worker.receive():
            self._heard_s = time.monotonic()
            match message:
                case Masks():
                    self._asked.pop(message.keyframe_id, None)
                    self.segmentation_ms.append(message.segmentation_ms)
                    found.append(message)
                case NotSegmented():
                    self._asked.pop(message.keyframe_id, None)
                    self.dropped += 1
                    logger.info("keyframe %d has no masks: %s", message.keyframe_id, message.reason)
                case Failure():
                    logger.error("the segmenter failed: %s", message.text)
        silent_s = time.monotonic() - self._heard_s
        if self.deaths > self.config.restarts:
            self._asked.clear()
        elif not self._worker.alive or (self._asked and silent_s > self.config.patience_s):
            self._restart()
        return found

    def close(self) -> None:
        """End the process at once."""
        self._worker.kill()

    def _start(self) -> Worker:
        return Worker("segmenter", "slam.live.segmentation:serve_segmenter", *self._arguments)

    def _first_words(self) -> tuple[str, ...]:
        deadline_s = time.monotonic() + self.config.start_s
        while time.monotonic() < deadline_s:
            for message in self._worker.receive(0.1):
                match message:
                    case Ready():
                        return message.labels
                    case Failure():
                        self.close()
                        raise InputError(message.text.strip().splitlines()[-1])
            if not self._worker.alive:
                break
        self.close()
        raise InputError("the segmenter's process did not start; see the lines above")

    def _restart(self) -> None:
        self.deaths += 1
        self._heard_s = time.monotonic()
        self._worker.kill()
        if self.deaths > self.config.restarts:
            logger.error("the segmenter died %d times; no masks from here on", self.deaths)
            return
        logger.warning("the segmenter died or hangs; started again, %d wait", len(self._asked))
        self._worker = self._start()
        for image in self._asked.values():
            self._worker.send(image)
