"""A network in a process of its own, which works while the keyframe enters the map."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import check_extra
from bmask_slam.live.messages import ImageToSegment, NotSegmented
from bmask_slam.live.processes.segmentation import MAX_KEPT, Queueing, RemoteSegmenter
from bmask_slam.live.processes.supervision import RestartPolicy
from bmask_slam.runtime.machine import available_cores
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter import Segmenter, check_image
from bmask_slam.semantics.segmenters.segmenter_table import (
    SegmenterOptions,
    labels_of,
    make_segmenter,
    measured_name,
    needed_by,
)
from bmask_slam.semantics.segmenters.upright import Upright

ANSWER_S = 600.0
"""Longest time for an image: a large network on an old processor takes a minute."""
POLL_S = 0.0005


class SegmenterBeside(RemoteSegmenter):
    """A segmenter whose answers are those that it would give in this process.

    Attributes:
        measured: under what name the errors of its masks were measured, "" if they were not.
    """

    queueing = Queueing(MAX_KEPT, newest_first=False, niceness=0)

    def __init__(
        self, options: SegmenterOptions, sequence: Path, upright: Upright | None = None
    ) -> None:
        """Start the process, for the images of a sequence.

        That of the shipped network is not waited for: it loads while the first frames are tracked.

        Raises:
            InputError: it cannot start.
        """
        super().__init__(options, sequence, RestartPolicy(answer_s=ANSWER_S), upright=upright)
        self.measured = measured_name(options)
        self._count = 0
        self._begun: dict[str, int] = {}
        self._found: dict[int, list[Instance]] = {}
        self._reasons: dict[int, str] = {}

    def _known_labels(self, options: SegmenterOptions, sequence: Path) -> LabelSet:
        if options.is_shipped and 0 <= options.min_score <= 1:
            return labels_of(options, sequence)
        return super()._known_labels(options, sequence)

    def begin(self, image: Image, name: str) -> None:
        """Begin with an image whose instances will be asked for later; returns at once."""
        if name not in self._begun:
            self._count += 1
            self._begun[name] = self._count
            self.request(ImageToSegment(self._count, image, name))

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances in an image, once they have come.

        Raises:
            InputError: the image cannot be segmented, or the process could not start, or died too
                often.
        """
        check_image(image, name)
        self.begin(image, name)
        if not self.worker.labels:
            self.worker.wait_until_ready()
        number = self._begun.pop(name)
        while number not in self._found and self.awaits(number):
            self._found |= {masks.keyframe_id: masks.instances for masks in self.receive_masks()}
            time.sleep(POLL_S)
        if number in self._found:
            return self._found.pop(number)
        died = f"{name}: the segmenter's process died too often"
        raise InputError(self._reasons.pop(number, died))

    def _not_segmented(self, message: NotSegmented) -> None:
        self._reasons[message.keyframe_id] = message.reason


@contextmanager
def segmenter_of_run(
    options: SegmenterOptions, sequence: Path, upright: Upright
) -> Iterator[Segmenter]:
    """The segmenter of an offline run: a network beside it, where there is a second processor.

    Raises InputError.
    """
    if options.is_network and not options.ray and available_cores() > 1:
        check_extra(*needed_by(options))
        with closing(SegmenterBeside(options, sequence, upright)) as segmenter:
            yield segmenter
    else:
        yield make_segmenter(options, sequence, find_weights, upright)
