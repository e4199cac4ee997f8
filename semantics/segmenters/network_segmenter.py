"""The network as a ``Segmenter``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import mirrored
from bmask_slam.semantics.network.mask_heads import expected_iou
from bmask_slam.semantics.network.model import Detections, MaskRCNN
from bmask_slam.semantics.segmenters.segmenter import check_image
from bmask_slam.semantics.segmenters.yolox import YoloxDetector
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork

MASK_THRESHOLD = 0.5
PADDING = 1
"""Cells of zeros around a mask, so that it fades out at the border of its box."""


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
        tensor = torch.from_numpy(np.ascontiguousarray(image)).to(self._device)
        tensor = tensor.permute(2, 0, 1).float() / 255
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


def paste(masks: Tensor, boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Probabilities (N, height, width) of masks (N, M, M) inside their boxes (N, 4).

    Bilinear and with pixel centres at half cells, that is s = (u + 0.5) m / w - 0.5 for a mask
    of m cells over w whole pixels. Being separable, it is two matrix products a mask.
    """
    if len(masks) == 0:
        return masks.new_zeros(0, *size)
    padded = F.pad(masks, (PADDING,) * 4)
    whole = _grown(boxes, padded.shape[-1] / masks.shape[-1])
    rows = _interpolation(whole[:, 1], whole[:, 3], padded.shape[1], size[0])
    columns = _interpolation(whole[:, 0], whole[:, 2], padded.shape[2], size[1])
    return rows.to(masks.dtype) @ padded @ columns.to(masks.dtype).transpose(1, 2)


def _grown(boxes: Tensor, factor: float) -> Tensor:
    """Boxes (N, 4) enlarged about their centres, as first and last pixels (rounded to zero)."""
    half = (boxes[:, 2:] - boxes[:, :2]) * 0.5 * factor
    centre = (boxes[:, 2:] + boxes[:, :2]) * 0.5
    return torch.cat([centre - half, centre + half], dim=1).long()


def _interpolation(first: Tensor, last: Tensor, cells: int, pixels: int) -> Tensor:
    """Weights (N, pixels, cells) of linear interpolation; rows outside first..last are zero."""
    length = (last - first + 1).clamp(min=1)[:, None]
    u = torch.arange(pixels, device=first.device) - first[:, None]
    source = ((u + 0.5) * (cells / length) - 0.5).clamp(0, cells - 1)
    cell = torch.arange(cells, device=first.device)
    weight = (1 - (source[..., None] - cell).abs()).clamp(min=0)
    return weight * ((u >= 0) & (u < length))[..., None]
