"""A segmenter on another machine, through Ray (``pip install 'bmask-slam[ray]'``).

The paper's segmentation runs on a workstation, the rest on the robot. On the workstation, after
installing this package: ``ray start --head --port 6379``. On the robot ``ray start --address
HOST:6379`` and ``--ray auto``; or, without joining the cluster, ``--ray ray://HOST:10001``. Files
such as weights and masks are read where the segmenter runs.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.ray_connection import connect
from bmask_slam.semantics.segmenters.segmenter import check_image

if TYPE_CHECKING:
    from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

logger = logging.getLogger(__name__)

START_S = 60.0
"""How long a segmenter may take to start there."""
PATIENCE_S = 15.0
"""How long an image may take, with its way there and back."""


class RaySegmenter:
    """Passes images on; an image that is lost with its machine or its network has no masks.

    Attributes:
        labels: of the segmenter there.
    """

    def __init__(self, options: SegmenterOptions, sequence: Path, address: str) -> None:
        """Start it there. Raises InputError where it cannot start."""
        self._ray = connect(address)
        self._arguments = (options, sequence)
        self._actor: Any = None
        self.labels: LabelSet = self._answer("label_set", START_S)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances that the segmenter there finds.

        Raises:
            InputError: what it refused, or that it is lost; the next image asks for another one.
        """
        check_image(image, name)
        found: list[Instance] = self._answer("segment", PATIENCE_S, image, name)
        return found

    def _answer(self, method: str, patience_s: float, *arguments: Any) -> Any:
        errors = self._ray.exceptions
        try:
            if self._actor is None:
                self._actor = self._start()
            asked = getattr(self._actor, method).remote(*arguments)
            return self._ray.get(asked, timeout=patience_s)
        except errors.RayTaskError as error:
            if isinstance(error.cause, InputError):
                raise error.cause from error
            raise
        except (errors.RayError, ConnectionError, TimeoutError) as error:
            self._give_up()
            reason = str(error).strip().splitlines()[0]
            raise InputError(f"the segmenter on Ray is lost ({reason})") from error

    def _start(self) -> Any:
        gpus = 1 if self._ray.cluster_resources().get("GPU", 0) >= 1 else 0
        there = self._ray.remote(num_gpus=gpus, max_concurrency=1)(_There)
        return there.remote(*self._arguments)

    def _give_up(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None:
            try:
                self._ray.kill(actor)
            except (self._ray.exceptions.RayError, ConnectionError, ValueError) as error:
                logger.debug("a lost segmenter cannot be ended: %s", error)


class _There:
    """Runs on the other machine; the first request makes the segmenter."""

    def __init__(self, *arguments: Any) -> None:
        self._arguments = arguments
        self._made: Any = None

    def label_set(self) -> LabelSet:
        labels: LabelSet = self._segmenter().labels
        return labels

    def segment(self, image: Image, name: str) -> list[Instance]:
        found: list[Instance] = self._segmenter().segment(image, name)
        return found

    def _segmenter(self) -> Any:
        from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter  # noqa: PLC0415  # which imports this

        if self._made is None:
            self._made = make_segmenter(*self._arguments)
        return self._made
