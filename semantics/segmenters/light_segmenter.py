"""The light network as a ``Segmenter``."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.model import Detections
from bmask_slam.semantics.network.yolox.mask_scoring import around
from bmask_slam.semantics.network.yolox.network import SIDE_PX, Features, decode
from bmask_slam.semantics.network.yolox.selection import SelectionConfig, select
from bmask_slam.semantics.network.yolox.stuff import STUFF_STRIDE
from bmask_slam.semantics.segmenters.network_segmenter import as_instances
from bmask_slam.semantics.segmenters.segmenter import check_image
from bmask_slam.semantics.segmenters.yolox import YoloxDetector
from bmask_slam.semantics.torch_threads import one_thread
from bmask_slam.semantics.weights.light_weights import LightNetwork
from bmask_slam.semantics.weights.stuff_weights import StuffNetwork

SURE_SCORE = 0.3


class LightSegmenter:
    """YOLOX-Nano with masks and a class for every pixel, one image at a time.

    It runs in one thread: two are hardly faster for layers so small, and beside other programs many
    times slower, since threads of OpenMP wait for each other without giving up their processor.

    Args:
        network: weights and the label set.
        min_score: class score below which a detection is dropped.
        detector: finds the boxes in place of the network's own.
        device: "cpu", "cuda", or None for CUDA if available.
        stuff: gives every pixel a class; None for instances alone.

    Attributes:
        labels: the label set.
        measured: under what name the errors of its masks were measured, "" if they were not.
    """

    measured = ""

    def __init__(
        self,
        network: LightNetwork,
        min_score: float = 0.5,
        detector: YoloxDetector | None = None,
        device: str | None = None,
        stuff: StuffNetwork | None = None,
    ) -> None:
        self.labels = network.labels
        self._device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self._model = network.model.to(self._device)
        self._detector = detector
        self._stuff = stuff
        if stuff is not None:
            stuff.head.to(self._device)
        self._selection = SelectionConfig(max(min_score, SelectionConfig.min_score))

    def segment(self, image: Image, name: str) -> Segmented:
        """Instances in an image (H, W, 3), best mask score first, and what all of it is."""
        check_image(image, name)
        size = (image.shape[0], image.shape[1])
        with torch.inference_mode(), one_thread():
            features, output, padded, factor = self._seen(image, SIDE_PX)
            if self._detector is None:
                found = self._selected(output[0], padded, factor, size, self._selection)
            else:
                found = self._detector.detect(image, self.labels).to(self._device)
            logits, ious = self._model.masks(features, [found.boxes * factor])
            masks = logits.sigmoid()
            every = Detections(found, masks, around(found.boxes), ious.clamp(0, 1))
            instances = as_instances(every, size, self._selection.min_score)
            return Segmented(instances, self._surfaces(features, output, factor, size))

    def evidence(self, image: Image) -> float:
        """The sum of class scores of what is surely in an image (H, W, 3); without masks."""
        check_image(image, "image")
        size = (image.shape[0], image.shape[1])
        with torch.inference_mode(), one_thread():
            _, output, padded, factor = self._seen(image, max(size))
            sure = SelectionConfig(SURE_SCORE)
            return float(self._selected(output[0], padded, factor, size, sure).scores.sum())

    def _seen(self, image: Image, side_px: int) -> tuple[Features, Tensor, Tensor, float]:
        """Features and raw detections of an image (H, W, 3), the input, and the factor to it."""
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self._device).permute(2, 0, 1)
        padded, factor = self._model.detector.letterboxed(tensor, side_px)
        features = self._model.detector.features(padded)
        return features, self._model.detector.detections(features), padded, factor

    def _selected(
        self,
        output: Tensor,
        padded: Tensor,
        factor: float,
        size: tuple[int, int],
        selection: SelectionConfig,
    ) -> ClassifiedBoxes:
        """Boxes in an image of (height, width), of which the input is ``factor`` times as large."""
        boxes, probabilities = decode(output, (padded.shape[2], padded.shape[3]))
        return select(boxes / factor, probabilities, size, self.labels, selection)

    def _surfaces(
        self, features: Features, output: Tensor, factor: float, size: tuple[int, int]
    ) -> SurfaceClasses | None:
        """The classes of all pixels; the cells of the input beyond the image are left out."""
        if self._stuff is None:
            return None
        cell_px = STUFF_STRIDE / factor
        rows, columns = (math.ceil(n / cell_px) for n in size)
        logits = self._stuff.head(features, output)[0, :, :rows, :columns]
        p = logits.softmax(dim=0).permute(1, 2, 0).half().cpu().numpy()
        return SurfaceClasses(self._stuff.labels, np.ascontiguousarray(p), cell_px, size)
