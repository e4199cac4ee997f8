"""Masks of images, kept for who asks again: the network need not see them twice."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance, PackedMask
from bmask_slam.semantics.instances.surfaces import (
    Segmented,
    SurfaceClasses,
    surfaces_of,
    up_of,
)
from bmask_slam.semantics.segmenters.segmenter import Segmenter, begin_early

_Packed = tuple[list[tuple[Instance, PackedMask]], SurfaceClasses | None, str]


class MaskMemory:
    """What a segmenter found in images, one bit a pixel, by the images' names."""

    def __init__(self) -> None:
        self._found: dict[str, _Packed] | None = {}

    def recall(self, name: str) -> list[Instance] | None:
        """The instances in an image; None if they are not known."""
        if self._found is None or name not in self._found:
            return None
        packed, surfaces, up = self._found[name]
        return Segmented([replace(i, mask=mask.unpacked()) for i, mask in packed], surfaces, up)

    def knows(self, name: str) -> bool:
        """Whether the instances in an image are known."""
        return self._found is not None and name in self._found

    def keep(self, name: str, instances: list[Instance]) -> None:
        """Keep the instances in an image."""
        if self._found is not None:
            nothing = np.zeros((0, 0), bool)  # no part of the mask, which would keep all of it
            packed = [(replace(i, mask=nothing), PackedMask.of(i.mask)) for i in instances]
            self._found[name] = packed, surfaces_of(instances), up_of(instances)

    def forget(self) -> None:
        """Keep nothing any more: no frame is tracked again."""
        self._found = None


class RememberingSegmenter:
    """A segmenter that finds in an image what it found the first time."""

    def __init__(self, segmenter: Segmenter, memory: MaskMemory) -> None:
        self.labels = segmenter.labels
        self.measured = getattr(segmenter, "measured", "")
        self._segmenter, self._memory = segmenter, memory

    def begin(self, image: Image, name: str) -> None:
        """Begin with an image that is not known, where the segmenter works beside this process."""
        if not self._memory.knows(name):
            begin_early(self._segmenter, image, name)

    def segment(self, image: Image, name: str) -> list[Instance]:
        """The instances in an image."""
        instances = self._memory.recall(name)
        if instances is None:
            instances = self._segmenter.segment(image, name)
            self._memory.keep(name, instances)
        return instances
