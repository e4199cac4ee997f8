"""A class for every pixel, stuff such as walls and floors too, on the features of YOLOX-Nano.

The detector's fine features (stride 8), its pyramid and its detections are read as they are; the
body's two coarse stages run once more with weights of their own, which start from the detector's.
A decoder goes from stride 32 to 8, with the mean over the image as context.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.yolox.layers import (
    ConvSiLU,
    CrossStage,
    PooledContext,
    separable,
)
from bmask_slam.semantics.network.yolox.network import (
    CLASSES,
    GEOMETRY,
    LEVEL_CHANNELS,
    PART_CHANNELS,
    STRIDES,
    Features,
    YoloxNano,
)

STUFF_STRIDE = STRIDES[0]
WIDTHS = (64, 96, 128)
"""Channels of the decoder at strides 8, 16 and 32."""
LARGEST_LOG_ODDS = 8.0


class Block(nn.Module):
    """x + a 5x5 convolution of each channel and a 1x1 convolution over the channels."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.spread = ConvSiLU(channels, channels, 5, groups=channels)
        self.mixed = ConvSiLU(channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """The same shape as x."""
        return x + self.mixed(self.spread(x))


class StuffHead(nn.Module):
    """Logits of the classes of pixels, one cell for 8x8 of them."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        fine, middle, coarse = WIDTHS
        self.stage_16 = nn.Sequential(separable(64, 128, 2), CrossStage(128, 128, 3))
        self.stage_32 = nn.Sequential(
            separable(128, 256, 2), PooledContext(256), CrossStage(256, 256, 1, residual=False)
        )
        detected = CLASSES + 1
        self.lateral_32 = ConvSiLU(256 + detected, coarse, 1)
        self.whole = ConvSiLU(coarse, coarse, 1)
        self.blocks_32 = nn.Sequential(Block(coarse), Block(coarse))
        self.lateral_16 = ConvSiLU(128 + LEVEL_CHANNELS[1] + detected, middle, 1)
        self.narrowed_32 = ConvSiLU(coarse, middle, 1)
        self.blocks_16 = nn.Sequential(Block(middle), Block(middle))
        self.lateral_8 = ConvSiLU(PART_CHANNELS + LEVEL_CHANNELS[0], fine, 1)
        self.narrowed_16 = ConvSiLU(middle, fine, 1)
        self.blocks_8 = nn.Sequential(Block(fine), Block(fine))
        self.logits = nn.Conv2d(fine, classes, 1)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def begin_from(self, detector: YoloxNano) -> None:
        """Copy the body's two coarse stages."""
        self.stage_16.load_state_dict(detector.body.stages[2].state_dict())
        self.stage_32.load_state_dict(detector.body.last.state_dict())

    def forward(self, features: Features, detections: Tensor) -> Tensor:
        """(B, classes, H/8, W/8) of the features and raw detections (B, P, 85) of (B, 3, H, W)."""
        parts = features.parts
        _, at_16, at_32 = _detected(detections, (parts.shape[2], parts.shape[3]))
        own_16 = self.stage_16(parts)
        own_32 = self.stage_32(own_16)
        x = self.lateral_32(torch.cat([own_32, at_32], dim=1))
        x = self.blocks_32(x + self.whole(x.mean(dim=(2, 3), keepdim=True)))
        lateral = self.lateral_16(torch.cat([own_16, features.levels[1], at_16], dim=1))
        x = self.blocks_16(lateral + _doubled(self.narrowed_32(x)))
        lateral = self.lateral_8(torch.cat([parts, features.levels[0]], dim=1))
        x = self.blocks_8(lateral + _doubled(self.narrowed_16(x)))
        return self.logits(x)


def _doubled(x: Tensor) -> Tensor:
    """(B, C, H, W) to (B, C, 2 H, 2 W), bilinear."""
    return F.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def _detected(detections: Tensor, size: tuple[int, int]) -> list[Tensor]:
    """Maps (B, 81, H/s, W/s) of the log odds of objectness and classes, for each stride.

    They are scaled to -1..1. ``size`` is that of the map of stride 8.
    """
    odds = torch.logit(detections[:, :, GEOMETRY - 1 :].float(), 1e-6)
    odds = odds.clamp(-LARGEST_LOG_ODDS, LARGEST_LOG_ODDS) / LARGEST_LOG_ODDS
    shapes = [(size[0] * STRIDES[0] // s, size[1] * STRIDES[0] // s) for s in STRIDES]
    maps = odds.to(detections.dtype).split([h * w for h, w in shapes], dim=1)
    return [m.transpose(1, 2).unflatten(2, s) for m, s in zip(maps, shapes, strict=True)]
