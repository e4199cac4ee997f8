"""The light network as a ``Segmenter``."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the network makes of an image.

    Attributes:
        features: its feature maps.
        output: (1, P, 85) raw detections.
        input_size: (height, width) of its input.
        factor: scale from the image to the input.
    """

    features: Features
    output: Tensor
    input_size: tuple[int, int]
    factor: float


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
            seen = self._seen(image, SIDE_PX)
            if self._detector is None:
                found = self._selected(seen, size, self._selection)
            else:
                found = self._detector.detect(image, self.labels).to(self._device)
            logits, ious = self._model.masks(seen.features, [found.boxes * seen.factor])
            masks = logits.sigmoid()
            every = Detections(found, masks, around(found.boxes), ious.clamp(0, 1))
            instances = as_instances(every, size, self._selection.min_score)
            return Segmented(instances, self._surfaces(seen, size))

    def evidence(self, image: Image) -> float:
        """The sum of class scores of what is surely in an image (H, W, 3); without masks."""
        check_image(image, "image")
        size = (image.shape[0], image.shape[1])
        with torch.inference_mode(), one_thread():
            sure = SelectionConfig(SURE_SCORE)
            found = self._selected(self._seen(image, max(size)), size, sure)
            return float(found.scores.sum())

    def _seen(self, image: Image, side_px: int) -> _Seen:
        """What the network makes of an image (H, W, 3), its longer side scaled to ``side_px``."""
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self._device).permute(2, 0, 1)
        padded, factor = self._model.detector.letterboxed(tensor, side_px)
        features = self._model.detector.features(padded)
        output = self._model.detector.detections(features)
        return _Seen(features, output, (padded.shape[2], padded.shape[3]), factor)

    def _selected(
        self, seen: _Seen, size: tuple[int, int], selection: SelectionConfig
    ) -> ClassifiedBoxes:
        """The detector's boxes in an image of (height, width) ``size``."""
        boxes, probabilities = decode(seen.output[0], seen.input_size)
        return select(boxes / seen.factor, probabilities, size, self.labels, selection)

    def _surfaces(self, seen: _Seen, size: tuple[int, int]) -> SurfaceClasses | None:
        """The classes of all pixels; the cells of the input beyond the image are left out."""
        if self._stuff is None:
            return None
        cell_px = STUFF_STRIDE / seen.factor
        rows, columns = (math.ceil(n / cell_px) for n in size)
        logits = self._stuff.head(seen.features, seen.output)[0, :, :rows, :columns]
        p = logits.softmax(dim=0).permute(1, 2, 0).half().cpu().numpy()
        return SurfaceClasses(self._stuff.labels, np.ascontiguousarray(p), cell_px, size)
