"""The keyframes of a run, one after the other, read and fused into its dense map."""

from __future__ import annotations

import logging
from dataclasses import dataclass

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.fusion import FusionCounts, KeyframeFusion
from bmask_slam.dense.input import MappedRun, image_name, load
from bmask_slam.dense.options import MapOptions
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.world.world_map import Keyframe

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class OpenMap:
    """A dense map that is being made.

    Attributes:
        run: what of.
        segmenter: finds instances in its images.
        folder: where it goes.
        options: as given, what they left open filled in.
    """

    run: MappedRun
    segmenter: Segmenter
    folder: DenseFolder
    options: MapOptions


class KeyframeWork:
    """One pass over the keyframes of a map, oldest first."""

    def __init__(self, opened: OpenMap) -> None:
        self._opened = opened
        labels = opened.segmenter.labels
        self._fusion = KeyframeFusion(opened.run.camera, labels, opened.folder, opened.options)

    @property
    def counts(self) -> FusionCounts:
        """What became of the keyframes."""
        return self._fusion.counts

    def take(self, keyframe: Keyframe) -> None:
        """Read a keyframe and save what its arrival finishes; leave out one that is broken.

        Raises:
            InputError: the disk is full.
        """
        run, segmenter = self._opened.run, self._opened.segmenter
        try:
            dense, whole = load(run, keyframe, self._opened.options.source)
            instances = segmenter.segment(whole.frame.rgb, image_name(run, keyframe))
        except InputError as error:
            logger.warning("%s; left out", error)
            self.counts.left_out[keyframe.id] = str(error)
            return
        shown = self._fusion.read(instances, whole.landmark_ids, whole.pixels)
        self._fusion.take(dense, whole.segment, shown, run.poses())

    def finish(self) -> None:
        """Save what still waits. Raises InputError if the disk is full."""
        self._fusion.finish()
