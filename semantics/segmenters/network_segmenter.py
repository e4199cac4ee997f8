"""The network as a ``Segmenter``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import mirrored
from bmask_slam.semantics.network.mask_heads import expected_iou
from bmask_slam.semantics.network.model import Detections, MaskRCNN
from bmask_slam.semantics.network.paste import paste
from bmask_slam.semantics.segmenters.segmenter import check_image
from bmask_slam.semantics.segmenters.yolox import YoloxDetector
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork

MASK_THRESHOLD = 0.5


class NetworkSegmenter:
    """Mask (Scoring) R-CNN, one image at a time.

    Args:
        network: weights and class names.
        min_score: class score below which a detection is dropped.
        detector: finds the boxes in place of the network's RPN and box head.
        device: "cpu", "cuda", or None for CUDA if available.
    """

    def __init__(
        self,
        network: TrainedNetwork,
        min_score: float = 0.5,
        detector: YoloxDetector | None = None,
        device: str | None = None,
    ) -> None:
        self.labels = network.labels
        self._device = device or ("cuda" if torch.cuda.is_available() else "cpu")
        self._model = network.model.to(self._device)
        self._min_score = min_score
        self._detector = detector

    @torch.inference_mode()
    def segment(self, image: Image, name: str) -> list[Instance]:
        """Instances in an image (H, W, 3), best mask score first."""
        check_image(image, name)
        tensor = torch.from_numpy(image).to(self._device).permute(2, 0, 1).float() / 255
        if self._detector is None:
            detections = self._model([tensor], self._min_score)[0]
        else:
            boxes = self._detector.detect(image, self.labels).to(self._device)
            detections = segment_both_ways(self._model, tensor, boxes)
        return as_instances(detections, (image.shape[0], image.shape[1]), self._min_score)


def segment_both_ways(model: MaskRCNN, image: Tensor, found: ClassifiedBoxes) -> Detections:
    """Masks of boxes in an image (3, H, W): means of those in the image and in its mirror image.

    The errors of the two are partly independent, so the error of the mean is smaller, for twice the
    time. The mask IoU is the mean of the MaskIoU head's values and of the IoU to expect from the
    mean mask's probabilities; a least-squares fit to true IoUs gives both equal weights.
    """
    turned = replace(found, boxes=mirrored(found.boxes, image.shape[2]))
    one, other = model.segment([image, image.flip(2)], [found, turned])
    masks = (one.masks + other.masks.flip(2)) / 2
    if model.roi_heads.maskiou_head is None:
        return replace(one, masks=masks)
    judged = (one.mask_ious + other.mask_ious) / 2
    return replace(one, masks=masks, mask_ious=(judged + expected_iou(masks)) / 2)


def as_instances(found: Detections, size: tuple[int, int], min_score: float) -> list[Instance]:
    """Detections as instances with masks of (height, width); empty masks are dropped."""
    keep = found.found.scores >= min_score
    boxes = found.found.boxes[keep]
    masks = (paste(found.masks[keep], found.mask_boxes[keep], size) > MASK_THRESHOLD).cpu().numpy()
    scores = found.found.scores[keep].cpu().numpy()
    mask_scores = scores * found.mask_ious[keep].cpu().numpy()
    labels = found.found.labels[keep].tolist()
    distributions = found.found.distributions[keep].cpu().numpy().astype(np.float32)
    box_array = boxes.cpu().numpy().astype(np.float32)
    order = np.argsort(-mask_scores, kind="stable")
    return [
        Instance(
            masks[k], box_array[k], labels[k], distributions[k], float(scores[k]),
            float(mask_scores[k]),
        )
        for k in order.tolist()
        if masks[k].any()
    ]  # fmt: skip
