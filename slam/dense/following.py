"""``run --map``: keyframes are fused as they come; ``map_run`` completes that at the end."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from bmask_slam.dense.assembly import assembled
from bmask_slam.dense.input import MappedRun
from bmask_slam.dense.keyframes import KeyframeWork
from bmask_slam.dense.options import MapOptions
from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.sequences import Sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_interface import System
from bmask_slam.tracking.results import FrameResult


class LastSegmentation:
    """A segmenter that is asked twice in a row for the same image and works once."""

    def __init__(self, segmenter: Segmenter) -> None:
        self.labels = segmenter.labels
        self._segmenter = segmenter
        self._name: str | None = None

    def segment(self, image: Image, name: str) -> list[Instance]:
        """What the segmenter finds."""
        if name != self._name:
            self._found = self._segmenter.segment(image, name)
            self._name = name
        return self._found


def dense_follower(system: System, sequence: Sequence, run: Path) -> Callable[[FrameResult], None]:
    """A function to call after every frame; it does nothing with a system of another kind.

    It needs no state of its own: what a killed run has not fused is fused at the end.

    Raises:
        InputError: later, when the disk is full.
    """
    if not isinstance(system, SlamSystem):
        return lambda result: None
    segmenter = system.semantics.segmenter = LastSegmentation(system.semantics.segmenter)
    masks = system.config.semantics.segmenter
    world = system.mapper.world
    mapped = MappedRun(run, world, [], sequence.camera, sequence=sequence)
    work = KeyframeWork(assembled(mapped, segmenter, MapOptions(run, masks=masks)))

    def follow(result: FrameResult) -> None:
        keyframe = world.keyframes.get(-1 if result.keyframe_id is None else result.keyframe_id)
        if keyframe is not None:
            work.take(keyframe)

    return follow
