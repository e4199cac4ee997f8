"""The mask head, and the MaskIoU head that predicts a mask's quality (Huang et al. 2019)."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.backbone.layers import (
    ConvBlock,
    NormKind,
    conv_stack,
    draw_normal,
    keep_variance,
)
from bmask_slam.semantics.network.config import NetworkConfig

BINS = 14
"""RoIAlign bins of both heads; masks have twice as many."""
OUTPUT_STD = 0.01
"""Initial standard deviation of the last layers' weights, so that first errors are small."""


def make_mask_head(config: NetworkConfig) -> nn.Sequential:
    """Four 3x3 convolutions: (R, C, 14, 14) to (R, mask_channels, 14, 14)."""
    norm: NormKind = "batch" if config.norm == "batch" else "none"
    head = nn.Sequential(*conv_stack(config.channels, config.mask_channels, 4, norm))
    keep_variance(head)
    return head


class MaskPredictor(nn.Module):
    """Doubles the resolution and predicts one mask a class, or a single one."""

    def __init__(self, channels: int, outputs: int) -> None:
        super().__init__()
        self.conv5_mask = nn.ConvTranspose2d(channels, channels, 2, 2)
        self.mask_fcn_logits = nn.Conv2d(channels, outputs, 1)
        keep_variance(self)
        draw_normal(self.mask_fcn_logits.weight, OUTPUT_STD)

    def forward(self, x: Tensor) -> Tensor:
        """(R, channels, 14, 14) to logits (R, outputs, 28, 28)."""
        return self.mask_fcn_logits(F.relu_(self.conv5_mask(x)))


class MaskIoUHead(nn.Module):
    """Predicts the IoU of a mask with the whole object, one value a class, or a single one.

    The input is the RoI's feature from before the mask head, with the mask as an extra channel.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, hidden = config.maskiou_channels, config.maskiou_hidden
        convs = OrderedDict()
        for k in range(1, 5):
            inputs = config.channels + 1 if k == 1 else width
            convs[f"maskiou_fcn{k}"] = ConvBlock((inputs, width), 3, stride=2 if k == 4 else 1)[0]
        self.convs = nn.Sequential(convs)
        self.maskiou_fc1 = nn.Linear(width * (BINS // 2) ** 2, hidden)
        self.maskiou_fc2 = nn.Linear(hidden, hidden)
        self.maskiou = nn.Linear(hidden, config.mask_outputs)
        keep_variance(self)
        draw_normal(self.maskiou.weight, OUTPUT_STD)

    def forward(self, features: Tensor, masks: Tensor) -> Tensor:
        """IoUs (R, outputs) of mask probabilities (R, 28, 28) with features (R, C, 14, 14)."""
        x = torch.cat([features, F.max_pool2d(masks[:, None], 2)], dim=1)
        for conv in self.convs:
            x = F.relu_(conv(x))
        x = F.relu_(self.maskiou_fc1(x.flatten(1)))
        return self.maskiou(F.relu_(self.maskiou_fc2(x)))


def of_class(values: Tensor, labels: Tensor) -> Tensor:
    """values[r, labels[r]]: the value of each RoI's class; or the single value there is."""
    if values.shape[1] == 1:
        return values[:, 0]
    return values[torch.arange(len(labels), device=values.device), labels]


def expected_iou(masks: Tensor) -> Tensor:
    """Expected IoU (R,) of masks, binarised at 0.5, if their probabilities (R, M, M) are right.

    The expected intersection with the object over the expected union, where each cell belongs to
    the object with its probability (Nowozin 2014, "Optimal decisions from probabilistic models:
    the intersection-over-union case"); 0 for an empty mask.
    """
    inside = masks > 0.5
    intersection = (masks * inside).sum(dim=(1, 2))
    union = inside.sum(dim=(1, 2)) + (masks * ~inside).sum(dim=(1, 2))
    return intersection / union.clamp(min=1e-6)
