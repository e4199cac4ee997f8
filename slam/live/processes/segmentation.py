"""Segmentation of keyframes in a process of its own."""

from __future__ import annotations

import logging
import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.errors import InputError
from bmask_slam.live.channel import Channel
from bmask_slam.live.messages import ImageToSegment, Masks, NotSegmented, Ready, Started
from bmask_slam.live.processes.supervision import DistantWorker, RestartPolicy, SupervisedWorker
from bmask_slam.live.processes.worker import Workstation
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter_table import (
    SegmenterOptions,
    labels_of,
    make_segmenter,
)
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.semantics.tracks.instance_track import load_filters

logger = logging.getLogger(__name__)

MAX_WAITING = 4
"""Largest number of keyframes that wait for segmentation; the oldest are skipped."""
MAX_KEPT = 100
"""The same for a workstation, which may go away and catches up when it is back."""
BEGINNING_S = 0.5
"""Longest wait of tracking for the masks of a keyframe that begins a map segment."""
MAX_IMAGE_CRASHES = 2
"""An image at which so many processes have died is left out."""


@dataclass(frozen=True)
class Queueing:
    """How many images may wait, which is next, and how far back the process stands for others."""

    most: int = MAX_WAITING
    newest_first: bool = True
    niceness: int = 15


def serve_segmenter(
    channel: Channel,
    options: SegmenterOptions,
    sequence: Path,
    upright: Upright,
    queueing: Queueing,
) -> None:
    """Segment images until the channel ends."""
    os.nice(queueing.niceness)
    segmenter = make_segmenter(options, sequence, find_weights, upright)
    channel.send(Ready(segmenter.labels.names))
    stack: list[ImageToSegment] = []
    while channel.open or stack:
        stack += channel.receive(0.0 if stack else 0.2)
        for late in stack[: -queueing.most]:
            channel.send(NotSegmented(late.keyframe_id, "newer keyframes came first"))
        stack = stack[-queueing.most :]
        if stack:
            image, started_s = stack.pop(-1 if queueing.newest_first else 0), time.perf_counter()
            channel.send(Started(image.keyframe_id))
            try:
                instances = segmenter.segment(image.rgb, image.name)
            except InputError as error:
                channel.send(NotSegmented(image.keyframe_id, str(error)))
                continue
            elapsed_ms = 1e3 * (time.perf_counter() - started_s)
            channel.send(Masks(image.keyframe_id, instances, elapsed_ms))


class RemoteSegmenter:
    """Sends keyframes' images to a process and receives their masks.

    Attributes:
        labels: classes of the segmenter.
        dropped: number of keyframes that were skipped.
        segmentation_ms: time of each keyframe that was segmented.
        urgent: keyframes whose masks are waited for, and until when (monotonic, seconds).
        worker: the supervised process.
    """

    queueing = Queueing()

    def __init__(
        self,
        options: SegmenterOptions,
        sequence: Path,
        policy: RestartPolicy | None = None,
        workstation: Workstation | None = None,
        upright: Upright | None = None,
    ) -> None:
        """Start the process and wait until it is ready, unless the workstation is away.

        It finds the side of the images that is up, unless ``upright`` says that or how.

        Raises:
            InputError: it cannot start, or only the workstation knows its classes and is away.
        """
        self.dropped = 0
        self.segmentation_ms: list[float] = []
        self.urgent: dict[int, float] = {}
        self._requested: dict[int, ImageToSegment] = {}
        self._working = -1  # the last image that the process has begun with
        self._crashes_at: Counter[int] = Counter()
        queueing = self.queueing if workstation is None else Queueing(MAX_KEPT)
        arguments, name = (options, sequence, upright or Upright(), queueing), "segmenter"
        self.worker: SupervisedWorker
        if workstation is not None:
            self.worker = DistantWorker(name, arguments, workstation)
        else:
            target = f"{__name__}:serve_segmenter"
            self.worker = SupervisedWorker(name, target, arguments, policy or RestartPolicy())
        load_filters()  # while the process loads its network
        try:
            self.labels = self._known_labels(options, sequence)
        except InputError:
            self.worker.close()
            raise

    def _known_labels(self, options: SegmenterOptions, sequence: Path) -> LabelSet:
        if not self.worker.is_away:
            return LabelSet(self.worker.wait_until_ready().labels)
        try:
            return labels_of(options, sequence)
        except InputError as error:
            raise InputError(f"the workstation does not answer, and without it: {error}") from error

    @property
    def waiting(self) -> int:
        """Number of keyframes whose masks have not come."""
        return len(self._requested)

    def awaits(self, keyframe_id: int) -> bool:
        """Whether the masks of a keyframe may still come."""
        return keyframe_id in self._requested

    def request(self, image: ImageToSegment) -> None:
        """Request the masks of a keyframe, whose image is copied; returns at once."""
        begins, image = not self._requested, replace(image, rgb=image.rgb.copy())
        self._requested[image.keyframe_id] = image
        if len(self._requested) > MAX_KEPT:  # of a process that is away
            del self._requested[next(iter(self._requested))]
            self.dropped += 1
        self.worker.send(image, begins)

    def hurry(self, keyframe_id: int, wait_s: float) -> None:
        """Let tracking wait so long for the masks of a keyframe, unless the workstation is away.

        A source that can wait does so longer (`LiveMap.catch_up`), also where this is 0.
        """
        if not self.worker.is_away:
            self.urgent[keyframe_id] = time.monotonic() + wait_s

    def waits_for_masks(self) -> bool:
        """Whether tracking still waits for masks; those whose time is over are urgent no more."""
        now_s = time.monotonic()
        self.urgent = {number: end_s for number, end_s in self.urgent.items() if now_s < end_s}
        return bool(self.urgent)

    def receive_masks(self) -> list[Masks]:
        """The masks that have come. A process that died or hangs is restarted."""
        found: list[Masks] = []
        messages = self.worker.receive()
        if self.worker.labels not in ((), self.labels.names):
            self._refuse_masks()
            messages = []
        for message in messages:
            match message:
                case Started():
                    self._working = message.number
                case Masks():
                    self._requested.pop(message.keyframe_id, None)
                    self.segmentation_ms.append(message.segmentation_ms)
                    found.append(message)
                case NotSegmented():
                    self._leave_out(message)
        self._restart_if_needed()
        return found

    def _restart_if_needed(self) -> None:
        """Send a new process what was requested, without an image at which two have died."""
        crashes, begun = self.worker.crashes, self._working
        is_new = self.worker.restart_if_needed(busy=bool(self._requested))
        if self.worker.crashes > crashes and begun in self._requested:
            self._working = -1  # of the next process
            self._crashes_at[begun] += 1
            if self._crashes_at[begun] >= MAX_IMAGE_CRASHES:
                self._leave_out(NotSegmented(begun, "the process crashed on it twice"))
        for image in self._requested.values() if is_new else ():
            self.worker.send(image)
        if self.worker.given_up:
            self._requested.clear()
            self.urgent.clear()

    def _leave_out(self, message: NotSegmented) -> None:
        self._requested.pop(message.keyframe_id, None)
        self.urgent.pop(message.keyframe_id, None)
        self._not_segmented(message)

    def _refuse_masks(self) -> None:
        if not self.worker.given_up:
            logger.error("the workstation's segmenter has other classes; its masks are not used")
            self.worker.give_up()

    def _not_segmented(self, message: NotSegmented) -> None:
        self.dropped += 1
        logger.info("keyframe %d has no masks: %s", message.keyframe_id, message.reason)

    def close(self) -> None:
        """Kill the process."""
        self.worker.close()
