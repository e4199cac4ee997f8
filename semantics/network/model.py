"""The whole network: body and feature pyramid (Lin et al. 2017), RPN, heads."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network import box_head, mask_heads
from bmask_slam.semantics.network.backbone import mobilenet, resnet
from bmask_slam.semantics.network.backbone.layers import ConvBlock, NormKind
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
"""Levels that RoIs are read from; the coarsest level is for the RPN only."""


@dataclass(frozen=True)
class Detections:
    """Detections in one image, best class score first.

    Attributes:
        found: boxes in pixels of the original image, labels, scores, class distributions.
        masks: (N, 28, 28) probabilities inside ``mask_boxes``, of each one's label.
        mask_boxes: (N, 4) the boxes, enlarged by the network's ``mask_context``.
        mask_ious: (N,) predicted IoU of the mask, in 0..1; 1 without a MaskIoU head.
    """

    found: ClassifiedBoxes
    masks: Tensor
    mask_boxes: Tensor
    mask_ious: Tensor


class FeaturePyramid(nn.Module):
    """Adds each level, upsampled by 2, to the next finer one; and one coarser level on top."""

    def __init__(self, inputs: Sequence[int], channels: int, norm: NormKind) -> None:
        super().__init__()
        inner = [ConvBlock((n, channels), 1, norm, relu=False) for n in inputs]
        self.inner_blocks = nn.ModuleList(inner)
        layer = [ConvBlock((channels, channels), 3, norm, relu=False) for _ in inputs]
        self.layer_blocks = nn.ModuleList(layer)
        for conv in self.modules():
            if isinstance(conv, nn.Conv2d):
                nn.init.kaiming_uniform_(conv.weight, a=1)

    def forward(self, features: Sequence[Tensor]) -> list[Tensor]:
        """Levels (B, channels, H_l, W_l), finest first; one more than there are features."""
        top = self.inner_blocks[-1](features[-1])
        levels = [self.layer_blocks[-1](top)]
        for i in range(len(features) - 2, -1, -1):
            lateral = self.inner_blocks[i](features[i])
            top = lateral + F.interpolate(top, size=lateral.shape[-2:], mode="nearest")
            levels.insert(0, self.layer_blocks[i](top))
        return [*levels, F.max_pool2d(levels[-1], 1, 2)]


class BackboneWithPyramid(nn.Module):
    """Images (B, 3, H, W) to the levels of strides 4, 8, 16, 32 and 64."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.body: nn.Module
        if config.backbone == "mobilenet_v2":
            self.body, inputs = mobilenet.MobileNetV2(), mobilenet.CHANNELS
        else:
            self.body, inputs = resnet.ResNet(config), resnet.CHANNELS
        norm: NormKind = "batch" if config.norm == "batch" else "none"
        self.fpn = FeaturePyramid(inputs, config.channels, norm)

    def forward(self, images: Tensor) -> list[Tensor]:
        """Five levels, finest first."""
        return self.fpn(self.body(images))


class RoIHeads(nn.Module):
    """The heads of each box: class and box, mask, MaskIoU."""

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

        Those with a class score below ``min_score``, or below the network's own limit, are dropped
        before the masks are computed.
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
        """Add masks, and scale boxes back to pixels of the original images."""
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
