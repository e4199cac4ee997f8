"""The feature pyramid (Lin et al. 2017) on top of a convolutional body."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.backbone import mobilenet, resnet
from bmask_slam.semantics.network.backbone.layers import ConvBlock, NormKind
from bmask_slam.semantics.network.config import NetworkConfig


class FeaturePyramid(nn.Module):
    """Adds each level, doubled in size, to the finer one below it; and one coarser level on top."""

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
