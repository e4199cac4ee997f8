"""The building blocks of YOLOX-Nano. Batch norm is folded into weights and biases."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F


class ConvSiLU(nn.Conv2d):
    """Convolution that keeps the size (at stride 1), and SiLU."""

    def __init__(
        self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1
    ) -> None:
        padding = (kernel - 1) // 2
        super().__init__(inputs, outputs, kernel, stride, padding, groups=groups)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return F.silu(super().forward(x), inplace=True)


def separable(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """A 3x3 convolution of each channel and a 1x1 convolution over the channels."""
    return nn.Sequential(
        ConvSiLU(inputs, inputs, 3, stride, groups=inputs), ConvSiLU(inputs, outputs, 1)
    )


class Bottleneck(nn.Module):
    """x + separable(conv1x1(x)), the sum only with ``residual``."""

    def __init__(self, channels: int, residual: bool) -> None:
        super().__init__()
        self.conv = nn.Sequential(ConvSiLU(channels, channels, 1), separable(channels, channels))
        self.residual = residual

    def forward(self, x: Tensor) -> Tensor:
        """The same shape as x."""
        y = self.conv(x)
        return y.add_(x) if self.residual else y


class CrossStage(nn.Module):
    """A cross-stage partial block: half of the channels passes through bottlenecks.

    Wang et al. 2020, "CSPNet".
    """

    def __init__(self, inputs: int, outputs: int, blocks: int, residual: bool = True) -> None:
        super().__init__()
        half = outputs // 2
        self.first = ConvSiLU(inputs, half, 1)
        self.second = ConvSiLU(inputs, half, 1)
        self.blocks = nn.Sequential(*(Bottleneck(half, residual) for _ in range(blocks)))
        self.joined = ConvSiLU(outputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H, W)."""
        return self.joined(torch.cat([self.blocks(self.first(x)), self.second(x)], dim=1))


class PooledContext(nn.Module):
    """Spatial pyramid pooling: each cell with the maxima of 5x5, 9x9 and 13x13 cells around it.

    Three poolings of 5x5 in sequence cover 5, 9 and 13 cells.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.narrowed = ConvSiLU(channels, channels // 2, 1)
        self.joined = ConvSiLU(2 * channels, channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """The same shape as x."""
        parts = [self.narrowed(x)]
        for _ in range(3):
            parts.append(F.max_pool2d(parts[-1], 5, 1, 2))
        return self.joined(torch.cat(parts, dim=1))


def with_doubled(coarse: Tensor, fine: Tensor) -> Tensor:
    """A level at twice its resolution, with the finer level's channels behind."""
    doubled = F.interpolate(coarse, scale_factor=2.0, mode="nearest")
    return torch.cat([doubled, fine], dim=1)


def convolutions(module: nn.Module) -> Sequence[nn.Conv2d]:
    """All convolutions in the order of their definition."""
    return [part for part in module.modules() if isinstance(part, nn.Conv2d)]
