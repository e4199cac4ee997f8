"""The light network as a ``Segmenter``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.network.model import Detections
from bmask_slam.semantics.network.yolox.mask_scoring import around
from bmask_slam.semantics.network.yolox.network import decode
from bmask_slam.semantics.network.yolox.selection import SelectionConfig, select
from bmask_slam.semantics.segmenters.network_segmenter import as_instances
from bmask_slam.semantics.segmenters.segmenter import check_image
from bmask_slam.semantics.weights.light_weights import LightNetwork


class LightSegmenter:
    """YOLOX-Nano with masks, one image at a time.

    It runs in one thread: two are hardly faster for layers so small, and beside other programs many
    times slower, since threads of OpenMP wait for each other without giving up their processor.

    Args:
        network: weights and the label set.
        min_score: class score below which a detection is dropped.
        device: "cpu", "cuda", or None for CUDA if available.
    """

    def __init__(
        self,
        network: LightNetwork,
        min_score: float = 0.5,
        device: str | None = None,
    ) -> None:
        self.labels = network.labels
        self._device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self._model = network.model.to(self._device)
        self._selection = SelectionConfig(max(min_score, SelectionConfig.min_score))

    def segment(self, image: Image, name: str) -> list[Instance]:
        """Instances in an image (H, W, 3), best mask score first."""
        check_image(image, name)
        with torch.inference_mode(), one_thread():
            tensor = torch.from_numpy(image).to(self._device).permute(2, 0, 1)
            found = self.detections(tensor)
            size = (image.shape[0], image.shape[1])
            return as_instances(found, size, self._selection.min_score)

    def detections(self, image: Tensor) -> Detections:
        """Boxes, masks and their quality in an image (3, H, W) of 0..255."""
        detector = self._model.detector
        padded, factor = detector.letterboxed(image)
        features = detector.features(padded)
        size = (padded.shape[2], padded.shape[3])
        boxes, probabilities = decode(detector.detections(features)[0], size)
        height, width = image.shape[1:]
        found = select(boxes / factor, probabilities, (height, width), self.labels, self._selection)
        logits, ious = self._model.masks(features, [found.boxes * factor])
        return Detections(found, logits.sigmoid(), around(found.boxes), ious.clamp(0, 1))


@contextmanager
def one_thread() -> Iterator[None]:
    """Within it torch runs in the calling thread alone."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
