"""The images of a finished run, and the masks of its keyframes, where both can be had again."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from bmask_slam.datasets.weights import find_weights
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import MAX_STAMP_ERROR_S, nearest_indices
from bmask_slam.labelling.upright_images import upright_of
from bmask_slam.run_folder.frame_file import FrameTable
from bmask_slam.run_folder.map_file import run_semantics
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.semantics.segmenters.segmenter import Segmenter
from bmask_slam.semantics.segmenters.segmenter_table import make_segmenter
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.viewer.scene import Scene
from bmask_slam.viewer.shown import as_jpeg

logger = logging.getLogger(__name__)

MAX_IMAGES, MAX_MASKS = 300, 80
"""Of a longer run some are shown, evenly."""


class ReplayPictures:
    """Shows images at some frames, and masks at some keyframes, made anew by the run's segmenter.

    What is not there any more (the recording, the network) is left out, with a warning.
    """

    def __init__(
        self, run: Path, sequence: Path | None, frames: FrameTable, camera: Camera
    ) -> None:
        """Images are those of the run's ``camera``; its recording may be in ``sequence`` now."""
        self._images, self._masked = self._chosen(frames)
        self._segmenter: Segmenter | None = None
        self._sequence = None
        try:
            self._sequence = open_sequence(sequence or find_sequence(run), camera=camera)
            folder, options = self._sequence.folder, run_semantics(run).segmenter
            if self._masked:
                upright = upright_of(options, self._sequence)
                self._segmenter = make_segmenter(options, folder, find_weights, upright)
        except InputError as error:
            what = "masks" if self._sequence is not None else "images"
            logger.warning("shown without %s: %s", what, error)

    @staticmethod
    def _chosen(frames: FrameTable) -> tuple[set[int], set[int]]:
        """Lines of frames.csv with an image, and of them the keyframes with masks."""
        every = max(-(-len(frames) // MAX_IMAGES), 1)
        keyframes = np.flatnonzero(frames.keyframe_ids >= 0)
        masked = keyframes[:: max(-(-len(keyframes) // MAX_MASKS), 1)].tolist()
        return {*range(0, len(frames), every), *masked}, set(masked)

    @property
    def names(self) -> tuple[str, ...]:
        """The segmenter's classes; none without one."""
        return self._segmenter.labels.names if self._segmenter else ()

    def show(self, line: int, timestamp_s: float, scene: Scene) -> None:
        """Show the image of a line of frames.csv, if it is chosen, and its masks."""
        if self._sequence is None or line not in self._images:
            return
        stamps_s: Array = self._sequence.timestamps_s
        index = int(nearest_indices(stamps_s, np.array([timestamp_s]))[0])
        if abs(stamps_s[index] - timestamp_s) > MAX_STAMP_ERROR_S:
            return
        try:
            frame = self._sequence.load(index)
        except InputError as error:
            logger.warning("not shown: %s", error)
            return
        jpeg = as_jpeg(frame.rgb)
        scene.log_image(jpeg)
        if self._segmenter is not None and line in self._masked:
            try:
                instances = self._segmenter.segment(frame.rgb, frame.name)
            except InputError as error:
                logger.warning("shown without masks: %s", error)
                return
            scene.log_masks(jpeg, instances, self.names)
