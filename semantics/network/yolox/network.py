"""YOLOX-Nano (Ge et al. 2021): CSPDarknet, a path-aggregation pyramid, a decoupled head.

Width 0.25, depth 0.33, depthwise convolutions, as published. Parts are defined in the order in
which they run, which is the order of the convolutions in the published ONNX file; names are this
project's own. The published first layer gathers 2x2 pixels into 12 channels and convolves them
3x3: that is a 6x6 convolution with stride 2 of the image.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network.yolox.layers import (
    ConvSiLU,
    CrossStage,
    PooledContext,
    separable,
    with_doubled,
)

STRIDES = (8, 16, 32)
MULTIPLE_PX = STRIDES[-1]
"""Both sides of the input are multiples of this."""
SIDE_PX = 640
"""Length that an image's longer side is scaled to."""
PAD_VALUE = 114
CLASSES = 80
GEOMETRY = 5
"""x, y, width, height and objectness come before the class probabilities."""
STEM_CHANNELS, EDGE_CHANNELS, PART_CHANNELS, LEVEL_CHANNELS = 16, 32, 64, (64, 128, 256)
HEAD_CHANNELS = 64
_STAGES = ((16, 32, 1), (32, 64, 3), (64, 128, 3))


class Features(NamedTuple):
    """Feature maps of images (B, 3, H, W).

    Attributes:
        stem: (B, 16, H/2, W/2), of the first layer.
        edges: (B, 32, H/4, W/4), of the body's first stage.
        parts: (B, 64, H/8, W/8), of the body's second stage.
        levels: (B, 64, 128, 256; H/8, H/16, H/32; ...) the pyramid's outputs.
    """

    stem: Tensor
    edges: Tensor
    parts: Tensor
    levels: tuple[Tensor, Tensor, Tensor]


class Body(nn.Module):
    """CSPDarknet: features of strides 2, 4, 8, 16 and 32; 16, 32, 64, 128 and 256 channels."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = ConvSiLU(3, 16, 6, 2)
        self.stages = nn.ModuleList(
            nn.Sequential(separable(n, m, 2), CrossStage(m, m, blocks)) for n, m, blocks in _STAGES
        )
        self.last = nn.Sequential(
            separable(128, 256, 2), PooledContext(256), CrossStage(256, 256, 1, residual=False)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Features of images (B, 3, H, W), finest first."""
        x = self.stem(x)
        features = [x]
        for stage in (*self.stages, self.last):
            x = stage(x)
            features.append(x)
        return features


class Pyramid(nn.Module):
    """A path-aggregation pyramid (Liu et al. 2018): coarse to fine, and back."""

    def __init__(self) -> None:
        super().__init__()
        self.narrowed_32 = ConvSiLU(256, 128, 1)
        self.down_16 = CrossStage(256, 128, 1, residual=False)
        self.narrowed_16 = ConvSiLU(128, 64, 1)
        self.down_8 = CrossStage(128, 64, 1, residual=False)
        self.halved_8 = separable(64, 64, 2)
        self.up_16 = CrossStage(128, 128, 1, residual=False)
        self.halved_16 = separable(128, 128, 2)
        self.up_32 = CrossStage(256, 256, 1, residual=False)

    def forward(self, at_8: Tensor, at_16: Tensor, at_32: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Levels with 64, 128 and 256 channels of the body's features of these strides."""
        top = self.narrowed_32(at_32)
        middle = self.narrowed_16(self.down_16(with_doubled(top, at_16)))
        fine = self.down_8(with_doubled(middle, at_8))
        middle = self.up_16(torch.cat([self.halved_8(fine), middle], dim=1))
        return fine, middle, self.up_32(torch.cat([self.halved_16(middle), top], dim=1))


class Head(nn.Module):
    """Class, box and objectness of every cell of one level."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        width = HEAD_CHANNELS
        self.narrowed = ConvSiLU(channels, width, 1)
        self.class_convs = nn.Sequential(separable(width, width), separable(width, width))
        self.classes = nn.Conv2d(width, CLASSES, 1)
        self.box_convs = nn.Sequential(separable(width, width), separable(width, width))
        self.boxes = nn.Conv2d(width, 4, 1)
        self.objectness = nn.Conv2d(width, 1, 1)

    def forward(self, level: Tensor) -> Tensor:
        """(B, H W, 85): box, objectness and class probabilities of the cells, row by row."""
        x = self.narrowed(level)
        classes = self.classes(self.class_convs(x)).sigmoid()
        x = self.box_convs(x)
        every = torch.cat([self.boxes(x), self.objectness(x).sigmoid(), classes], dim=1)
        return every.flatten(2).transpose(1, 2)


class YoloxNano(nn.Module):
    """Features and raw detections of images."""

    def __init__(self) -> None:
        super().__init__()
        self.body = Body()
        self.pyramid = Pyramid()
        self.heads = nn.ModuleList(Head(n) for n in LEVEL_CHANNELS)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def letterboxed(self, image: Tensor, side_px: int = SIDE_PX) -> tuple[Tensor, float]:
        """The input (1, 3, H, W) of an image (3, h, w) in 0..255, and the factor of its scale.

        The image is at the upper left, its longer side ``side_px``; the rest is grey.
        """
        factor = side_px / max(image.shape[1:])
        height, width = (max(int(n * factor), 1) for n in image.shape[1:])
        scaled = image[None].float()
        if factor != 1:
            scaled = F.interpolate(scaled, (height, width), mode="bilinear", antialias=factor < 1)
        sides = (-(-n // MULTIPLE_PX) * MULTIPLE_PX for n in (height, width))
        padded = image.new_full((1, 3, *sides), PAD_VALUE, dtype=torch.float32)
        padded = padded.to(memory_format=torch.channels_last)
        padded[:, :, :height, :width] = scaled
        return padded, factor

    def features(self, images: Tensor) -> Features:
        """Features of images (B, 3, H, W), red first in 0..255; sides are multiples of 32."""
        stem, edges, *rest = self.body(images)
        return Features(stem, edges, rest[0], self.pyramid(*rest))

    def detections(self, features: Features) -> Tensor:
        """(B, P, 85), to be decoded by ``decode``: cells of stride 8, then 16, then 32."""
        levels = zip(self.heads, features.levels, strict=True)
        return torch.cat([head(level) for head, level in levels], dim=1)


def decode(output: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Boxes (P, 4) in pixels of the input, and class probabilities (P, 80) times objectness.

    Args:
        output: (P, 85) of one image.
        size: (height, width) of the input.

    Row (x, y, w, h, o, c...) of a cell (column, row) of stride s: centre (x + column, y + row) s,
    size (exp(w), exp(h)) s; rows in the order of the strides, then of rows and columns.
    """
    cells, steps = [], []
    for stride in STRIDES:
        rows, columns = (torch.arange(n // stride, device=output.device) for n in size)
        cell = torch.cartesian_prod(rows, columns).flip(1)
        cells.append(cell)
        steps.append(torch.full((len(cell), 1), stride, device=output.device))
    step = torch.cat(steps)
    centre = (output[:, :2] + torch.cat(cells)) * step
    half = 0.5 * torch.exp(output[:, 2:4]) * step
    boxes = torch.cat([centre - half, centre + half], dim=1)
    return boxes, output[:, GEOMETRY - 1 : GEOMETRY] * output[:, GEOMETRY:]
