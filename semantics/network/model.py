"""The whole network: images in, instances out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from bmask_slam.semantics.network import box_head, mask_heads
from bmask_slam.semantics.network.backbone.pyramid import BackboneWithPyramid
from bmask_slam.semantics.network.box_head import (
    BoxPredictor,
    ClassifiedBoxes,
    classify,
    make_box_head,
)
from bmask_slam.semantics.network.boxes import enlarged, rescale
from bmask_slam.semantics.network.config import NetworkConfig
from bmask_slam.semantics.network.images import ImageBatch, prepare
from bmask_slam.semantics.network.mask_heads import (
    MaskIoUHead,
    MaskPredictor,
    make_mask_head,
    of_class,
)
from bmask_slam.semantics.network.roi_align import FeatureTable, feature_table, roi_align
from bmask_slam.semantics.network.rpn import RegionProposalNetwork

ROI_LEVELS = 4
"""The coarsest pyramid level serves the RPN alone."""


@dataclass(frozen=True)
class Detections:
    """What the network says about one image, best class score first.

    Attributes:
        found: boxes in pixels of the original image, labels, scores, class distributions.
        masks: (N, 28, 28) probabilities inside ``mask_boxes``, of each one's label.
        mask_boxes: (N, 4) the boxes, enlarged by the network's ``mask_context``.
        mask_ious: (N,) predicted IoU of the mask, in 0..1; ones without a MaskIoU head.
    """

    found: ClassifiedBoxes
    masks: Tensor
    mask_boxes: Tensor
    mask_ious: Tensor


class RoIHeads(nn.Module):
    """What is computed for each box: class and box, mask, MaskIoU."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.box_head = make_box_head(config)
        self.box_predictor = BoxPredictor(config.box_hidden, config.classes)
        self.mask_head = make_mask_head(config)
        self.mask_predictor = MaskPredictor(config.mask_channels, config.mask_outputs)
        self.maskiou_head = MaskIoUHead(config) if config.maskiou_channels else None

    def boxes(self, table: FeatureTable, proposals: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Class logits (R, classes) and offsets (R, classes, 4) of all images' proposals."""
        features = roi_align(table, proposals, box_head.BINS)
        logits, offsets = self.box_predictor(self.box_head(features))
        return logits, offsets

    def masks(
        self, table: FeatureTable, boxes: Sequence[Tensor], labels: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mask probabilities (R, 28, 28) and predicted IoUs (R,) of each box's label (R,)."""
        features = roi_align(table, boxes, mask_heads.BINS)
        logits = self.mask_predictor(self.mask_head(features))
        masks = of_class(logits, labels).sigmoid()
        if self.maskiou_head is None:
            return masks, torch.ones_like(labels, dtype=masks.dtype)
        return masks, of_class(self.maskiou_head(features, masks), labels).clamp(0, 1)


class MaskRCNN(nn.Module):
    """Mask (Scoring) R-CNN; the names of its parameters are torchvision's."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.config = config
        self.backbone = BackboneWithPyramid(config)
        self.rpn = RegionProposalNetwork(config)
        self.roi_heads = RoIHeads(config)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def forward(self, images: Sequence[Tensor], min_score: float = 0.0) -> list[Detections]:
        """Detections of each image (3, H, W), float32, red green blue in 0..1.

        Those of a class score below ``min_score``, or below the network's own limit, get no mask
        and are left out.
        """
        batch = prepare(images, self.config.image)
        levels = self.backbone(batch.tensor)
        table = feature_table(levels[:ROI_LEVELS], batch.size[0])
        proposals = self.rpn(levels, batch)
        return self._with_masks(table, self._classified(table, proposals, batch, min_score), batch)

    def segment(
        self, images: Sequence[Tensor], given: Sequence[ClassifiedBoxes]
    ) -> list[Detections]:
        """Masks for boxes that another detector found, in pixels of the original images."""
        batch = prepare(images, self.config.image)
        table = feature_table(self.backbone(batch.tensor)[:ROI_LEVELS], batch.size[0])
        sizes = zip(given, batch.original_sizes, batch.sizes, strict=True)
        return self._with_masks(table, [_moved(g, old, new) for g, old, new in sizes], batch)

    def _classified(
        self,
        table: FeatureTable,
        proposals: Sequence[Tensor],
        batch: ImageBatch,
        min_score: float,
    ) -> list[ClassifiedBoxes]:
        """The box head's detections in each image, in pixels of the batch."""
        usual = self.config.detections
        config = replace(usual, min_score=max(usual.min_score, min_score))
        counts = [len(p) for p in proposals]
        logits, offsets = self.roi_heads.boxes(table, proposals)
        outputs = zip(
            logits.split(counts), offsets.split(counts), proposals, batch.sizes, strict=True
        )
        return [classify(*output, config) for output in outputs]

    def _with_masks(
        self, table: FeatureTable, found: Sequence[ClassifiedBoxes], batch: ImageBatch
    ) -> list[Detections]:
        """Masks added, boxes back in pixels of the original images."""
        counts = [len(f.boxes) for f in found]
        labels = torch.cat([f.labels for f in found])
        around = [enlarged(f.boxes, self.config.mask_context) for f in found]
        masks, ious = self.roi_heads.masks(table, around, labels)
        parts = zip(found, around, masks.split(counts), ious.split(counts), strict=True)
        sizes = zip(batch.sizes, batch.original_sizes, strict=True)
        return [
            Detections(_moved(f, *size), m, rescale(a, *size), i)
            for (f, a, m, i), size in zip(parts, sizes, strict=True)
        ]


def _moved(found: ClassifiedBoxes, old: tuple[int, int], new: tuple[int, int]) -> ClassifiedBoxes:
    """The same boxes in the image resized from (height, width) ``old`` to ``new``."""
    return replace(found, boxes=rescale(found.boxes, old, new))
