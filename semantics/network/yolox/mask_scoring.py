"""Masks and their quality in the boxes of YOLOX-Nano: a Mask Scoring R-CNN on its features.

One pass over the image; what comes after it, only for the boxes that are kept. A RoI's features
are those of strides 4, 8 and 16 side by side, since boxes are few and maps are large: no layer of
this project's own runs over the whole image. Masks do not depend on the class.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.backbone.layers import conv_stack, draw_normal, keep_variance
from bmask_slam.semantics.network.boxes import enlarged
from bmask_slam.semantics.network.mask_heads import BINS, OUTPUT_STD, expected_iou
from bmask_slam.semantics.network.roi_align import feature_table, roi_align
from bmask_slam.semantics.network.yolox.network import (
    EDGE_CHANNELS,
    LEVEL_CHANNELS,
    STEM_CHANNELS,
    STRIDES,
    Features,
    YoloxNano,
)

CONTEXT = 1.2
"""Factor by which boxes are enlarged about their centres for their masks."""
MASK_BINS = 2 * BINS
WIDTH, FINE_WIDTH, IOU_WIDTH, IOU_HIDDEN = 64, 32, 32, 128
_STEM_STRIDE, _EDGE_STRIDE = 2, 4


class MaskHead(nn.Module):
    """Mask of each RoI: 14x14 cells of context, doubled, with what the image's edges show."""

    def __init__(self) -> None:
        super().__init__()
        self.convs = nn.Sequential(*conv_stack(WIDTH, WIDTH, 3, "none"))
        self.doubled = nn.ConvTranspose2d(WIDTH, FINE_WIDTH, 2, 2)
        self.edges = nn.Conv2d(STEM_CHANNELS + EDGE_CHANNELS, FINE_WIDTH, 1)
        self.fine = nn.Sequential(*conv_stack(FINE_WIDTH, FINE_WIDTH, 1, "none"))
        self.logits = nn.Conv2d(FINE_WIDTH, 1, 1)
        keep_variance(self)
        draw_normal(self.logits.weight, OUTPUT_STD)

    def forward(self, features: Tensor, edges: Tensor) -> Tensor:
        """Logits (R, 28, 28) from (R, 64, 14, 14) and (R, 48, 28, 28)."""
        x = self.doubled(self.convs(features)) + self.edges(edges)
        return self.logits(self.fine(F.relu_(x)))[:, 0]


class QualityHead(nn.Module):
    """The MaskIoU head (Huang et al. 2019, section 3.2), narrow.

    It corrects the IoU that the mask's own probabilities let expect.
    """

    def __init__(self) -> None:
        super().__init__()
        self.convs = nn.Sequential(*conv_stack(WIDTH + 1, IOU_WIDTH, 3, "none"))
        self.halved = nn.Conv2d(IOU_WIDTH, IOU_WIDTH, 3, 2, 1)
        self.hidden = nn.Linear(IOU_WIDTH * (BINS // 2) ** 2 + 1, IOU_HIDDEN)
        self.correction = nn.Linear(IOU_HIDDEN, 1)
        keep_variance(self)
        draw_normal(self.correction.weight, OUTPUT_STD)

    def forward(self, features: Tensor, masks: Tensor) -> Tensor:
        """IoUs (R,) with the whole object of masks (R, 28, 28) with features (R, 64, 14, 14)."""
        pooled = F.max_pool2d(masks[:, None], 2).to(features)
        x = F.relu_(self.halved(self.convs(torch.cat([features, pooled], dim=1))))
        expected = expected_iou(masks)[:, None].to(x)
        x = F.relu_(self.hidden(torch.cat([x.flatten(1), expected], dim=1)))
        return (expected + self.correction(x))[:, 0]


class MaskScoringYolox(nn.Module):
    """YOLOX-Nano with a mask head and a MaskIoU head."""

    def __init__(self) -> None:
        super().__init__()
        self.detector = YoloxNano()
        inputs = EDGE_CHANNELS + LEVEL_CHANNELS[0] + LEVEL_CHANNELS[1]
        self.narrowed = nn.Conv2d(inputs, WIDTH, 1)
        self.mask = MaskHead()
        self.quality = QualityHead()
        keep_variance(self.narrowed)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def masks(self, features: Features, boxes: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Logits (R, 28, 28) of masks and predicted IoUs (R,).

        ``boxes`` (R_b, 4) of each image are in pixels of the input; a mask covers ``around`` them.
        """
        outer = [around(b) for b in boxes]
        levels = (features.edges, *features.levels[:2])
        strides = (_EDGE_STRIDE, *STRIDES[:2])
        coarse = [
            _aligned(level, stride, outer, BINS)
            for level, stride in zip(levels, strides, strict=True)
        ]
        x = F.relu_(self.narrowed(torch.cat(coarse, dim=1)))
        fine = [
            _aligned(features.stem, _STEM_STRIDE, outer, MASK_BINS),
            _aligned(features.edges, _EDGE_STRIDE, outer, MASK_BINS),
        ]
        logits = self.mask(x, torch.cat(fine, dim=1))
        return logits, self.quality(x, logits.detach().float().sigmoid())


def around(boxes: Tensor) -> Tensor:
    """The boxes (N, 4) that masks cover."""
    return enlarged(boxes, CONTEXT)


def _aligned(level: Tensor, stride: int, boxes: Sequence[Tensor], bins: int) -> Tensor:
    """Features (R, C, bins, bins) of a level (B, C, H, W), whose cell 0 covers pixels 0..stride.

    ``roi_align`` has the centre of cell 0 at pixel 0, so boxes are moved by half a stride.
    """
    table = feature_table([level], level.shape[2] * stride)
    return roi_align(table, [b - 0.5 * stride for b in boxes], bins)
