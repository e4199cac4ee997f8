"""A segmenter on another machine, through Ray (``pip install 'bmask-slam[ray]'``).

The paper's segmentation runs on a workstation, the rest on the robot. On the workstation, after
installing this package: ``ray start --head --port 6379``. On the robot ``ray start --address
HOST:6379`` and ``--ray auto``; or, without joining the cluster, ``--ray ray://HOST:10001``. Files
such as weights and masks are read on the machine that runs the segmenter.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.ray_connection import connect
from bmask_slam.semantics.segmenters.segmenter import Segmenter, check_image

logger = logging.getLogger(__name__)

START_TIMEOUT_S = 300.0
"""Limit for the start of the segmenter there; a busy machine needs minutes to load a network."""
IMAGE_TIMEOUT_S = 15.0
"""Limit for one image, transfer both ways included."""


class RaySegmenter:
    """Sends images to a Ray actor; a failure of the actor or the network costs one image.

    Attributes:
        labels: label set of the remote segmenter.
        measured: under what name the errors of its masks were measured, "" if they were not.
    """

    measured = ""

    def __init__(self, make: Callable[[], Segmenter], address: str) -> None:
        """Start ``make()``, which must be picklable, in an actor of the cluster at ``address``.

        Raises:
            InputError: no cluster, or the segmenter cannot start.
        """
        self._ray = connect(address)
        self._make = make
        self._actor: Any = None
        self.labels: LabelSet = self._call("label_set", START_TIMEOUT_S)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances that the remote segmenter finds.

        Raises:
            InputError: refused by the remote segmenter, or the actor is lost; the next image starts
                a new actor.
        """
        check_image(image, name)
        found: list[Instance] = self._call("segment", IMAGE_TIMEOUT_S, image, name)
        return found

    def _call(self, method: str, timeout_s: float, *arguments: Any) -> Any:
        errors = self._ray.exceptions
        try:
            if self._actor is None:
                self._actor, timeout_s = self._start(), START_TIMEOUT_S
            result = getattr(self._actor, method).remote(*arguments)
            return self._ray.get(result, timeout=timeout_s)
        except errors.RayTaskError as error:
            if isinstance(error.cause, InputError):
                raise error.cause from error
            raise
        except (errors.RayError, ConnectionError, TimeoutError) as error:
            self._kill_actor()
            reason = str(error).strip().partition("\n")[0] or type(error).__name__
            raise InputError(f"the segmenter on Ray is lost ({reason})") from error

    def _start(self) -> Any:
        gpus = 1 if self._ray.cluster_resources().get("GPU", 0) >= 1 else 0
        return self._ray.remote(num_gpus=gpus, max_concurrency=1)(_Actor).remote(self._make)

    def _kill_actor(self) -> None:
        actor, self._actor = self._actor, None
        if actor is not None:
            try:
                self._ray.kill(actor)
            except (self._ray.exceptions.RayError, ConnectionError, ValueError) as error:
                logger.debug("a lost segmenter cannot be ended: %s", error)


class _Actor:
    """Runs on the other machine; the first request makes the segmenter."""

    def __init__(self, make: Callable[[], Segmenter]) -> None:
        self._make = make
        self._segmenter: Segmenter | None = None

    def label_set(self) -> LabelSet:
        return self._made().labels

    def segment(self, image: Image, name: str) -> list[Instance]:
        return self._made().segment(image, name)

    def _made(self) -> Segmenter:
        if self._segmenter is None:
            self._segmenter = self._make()
        return self._segmenter
