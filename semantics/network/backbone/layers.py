"""Convolutions with batch norm, which is folded into the weights while its statistics are fixed.

Child modules are numbered as torchvision's ``Conv2dNormActivation`` numbers them, so that the
names of parameters agree: "0" is the convolution, "1" its norm.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import torch
from torch import Tensor, nn
from torch.nn import functional as F

NormKind = Literal["frozen", "batch", "none"]


class FrozenBatchNorm2d(nn.Module):
    """Batch norm whose statistics and affine parameters are constants: y = x * scale + shift."""

    weight: Tensor
    bias: Tensor
    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int, eps: float) -> None:
        super().__init__()
        self.eps = eps
        self.register_buffer("weight", torch.ones(channels))
        self.register_buffer("bias", torch.zeros(channels))
        self.register_buffer("running_mean", torch.zeros(channels))
        self.register_buffer("running_var", torch.ones(channels))


Norm: TypeAlias = FrozenBatchNorm2d | nn.BatchNorm2d


def make_norm(kind: NormKind, channels: int, eps: float) -> Norm:
    """A batch norm of the given kind; there is none of kind "none"."""
    if kind == "frozen":
        return FrozenBatchNorm2d(channels, eps)
    if kind == "batch":
        return nn.BatchNorm2d(channels, eps)
    raise ValueError(f"no batch norm of kind {kind!r}")


def conv_norm(conv: nn.Conv2d, norm: Norm, x: Tensor) -> Tensor:
    """norm(conv(x)), as one convolution if the statistics are fixed.

    (W x - mean) * w / sqrt(var + eps) + b is a convolution with scaled weights. Scaling them at
    every call is cheap compared with a pass over the activations, and needs no second copy of the
    weights.
    """
    if isinstance(norm, nn.BatchNorm2d) and norm.training:
        return norm(conv(x))
    mean, variance = norm.running_mean, norm.running_var
    assert mean is not None and variance is not None  # a batch norm that tracks its statistics
    scale = norm.weight * (variance + norm.eps).rsqrt()
    shift = norm.bias - mean * scale
    weight = conv.weight * scale[:, None, None, None]
    return F.conv2d(x, weight, shift, conv.stride, conv.padding)


class ConvBlock(nn.Sequential):
    """Convolution, optional batch norm, optional ReLU; (B, in, H, W) to (B, out, H, W)."""

    def __init__(
        self,
        channels: tuple[int, int],
        kernel: int,
        norm: NormKind = "none",
        relu: bool = True,
        stride: int = 1,
    ) -> None:
        plain = norm == "none"
        conv = nn.Conv2d(*channels, kernel, stride, padding=kernel // 2, bias=plain)
        super().__init__(conv, *([] if plain else [make_norm(norm, channels[1], 1e-5)]))
        self.relu = relu

    def forward(self, x: Tensor) -> Tensor:
        """The activations after convolution, norm and ReLU."""
        y = self[0](x) if len(self) == 1 else conv_norm(self[0], self[1], x)  # type: ignore[arg-type]
        return F.relu_(y) if self.relu else y


def keep_variance(module: nn.Module) -> None:
    """Initialise all weights inside so that ReLU layers keep the variance (He et al. 2015).

    Not those on the meta device, see ``draw_normal``.
    """
    for part in module.modules():
        if isinstance(part, nn.Conv2d | nn.ConvTranspose2d | nn.Linear) and not part.weight.is_meta:
            nn.init.kaiming_normal_(part.weight, nonlinearity="relu")
            if part.bias is not None:
                nn.init.zeros_(part.bias)


def draw_normal(weight: Tensor, std: float) -> None:
    """Initialise weights by a normal distribution, but for those on the meta device.

    These have no values, and to draw some torch would load its compiler: 0.7 s and 60 MB.
    """
    if not weight.is_meta:
        nn.init.normal_(weight, std=std)


def conv_stack(channels: int, width: int, count: int, norm: NormKind) -> list[ConvBlock]:
    """A sequence of 3x3 blocks, the first from ``channels`` to ``width``."""
    inputs = [channels, *[width] * (count - 1)]
    return [ConvBlock((n, width), 3, norm) for n in inputs[:count]]
