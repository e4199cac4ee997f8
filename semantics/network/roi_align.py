"""RoIAlign (He et al. 2017): features of any box, resampled to a small fixed grid.

Each bin averages 2x2 bilinear samples. Bilinear weights are separable, so a bin is a weighted sum
of 4 rows times 4 columns = 16 feature vectors. ``embedding_bag`` computes weighted sums of rows of
a table: with all pyramid levels as one table of feature vectors, every bin of every box is a bag,
and no intermediate is stored. Works on CPU and CUDA, with gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.semantics.network.boxes import area

SAMPLES = 2
"""Bilinear samples of a bin along each axis."""
CANONICAL_SIZE_PX = 224.0
CANONICAL_LEVEL = 4
"""A box of 224 px belongs to level 4 (stride 16), as in ImageNet training."""


@dataclass(frozen=True)
class FeatureTable:
    """Feature vectors of all levels and images as the rows of one table.

    Attributes:
        rows: (sum over levels of B H_l W_l, C), channels last.
        starts: (L,) first row of each level.
        sizes: (L, 2) height and width of each level.
        scales: (L,) cells a pixel of the input.
        first_level: log2 of the finest level's stride.
    """

    rows: Tensor
    starts: Tensor
    sizes: Tensor
    scales: Tensor
    first_level: int


def feature_table(levels: Sequence[Tensor], image_height_px: int) -> FeatureTable:
    """The table of levels (B, C, H_l, W_l) of images of this height, finest first.

    Each level's scale is the nearest power of two, since sizes are rounded up on the way down.
    """
    device, channels = levels[0].device, levels[0].shape[1]
    rows = torch.cat([f.permute(0, 2, 3, 1).reshape(-1, channels) for f in levels])
    counts = torch.tensor([f.shape[0] * f.shape[2] * f.shape[3] for f in levels], device=device)
    sizes = torch.tensor([f.shape[-2:] for f in levels], device=device)
    exponents = torch.round(torch.log2(sizes[:, 0].float() / image_height_px))
    first_level = -int(exponents[0])
    return FeatureTable(rows, counts.cumsum(0) - counts, sizes, torch.exp2(exponents), first_level)


def assign_levels(boxes: Tensor, first_level: int, count: int) -> Tensor:
    """The level (N,), from 0, that each box (N, 4) is read from (Lin et al. 2017, eq. 1)."""
    size_px = torch.sqrt(area(boxes))
    level = torch.floor(CANONICAL_LEVEL + torch.log2(size_px / CANONICAL_SIZE_PX) + 1e-6)
    return level.clamp(first_level, first_level + count - 1).long() - first_level


def roi_align(table: FeatureTable, boxes: Sequence[Tensor], bins: int) -> Tensor:
    """Features (R, C, bins, bins) of the boxes (R_b, 4) of each image b, R = sum of R_b.

    Coordinates are those of Detectron's first version ("aligned=False"): the centre of cell 0
    lies at 0, and a box is at least one cell wide. The result is channels-last in memory.
    """
    every = torch.cat(list(boxes))
    count = len(table.starts)
    level = assign_levels(every, table.first_level, count)
    image = torch.repeat_interleave(
        torch.tensor([len(b) for b in boxes], device=every.device), output_size=len(every)
    )
    height, width = table.sizes[level].unbind(1)
    scaled = every * table.scales[level, None]
    row, row_weight = axis_taps(scaled[:, 1], scaled[:, 3], height, bins)
    column, column_weight = axis_taps(scaled[:, 0], scaled[:, 2], width, bins)
    start = table.starts[level] + image * height * width
    index = (start[:, None, None] + row * width[:, None, None])[:, :, None, :, None]
    index = index + column[:, None, :, None, :]
    weight = row_weight[:, :, None, :, None] * column_weight[:, None, :, None, :]
    taps = (2 * SAMPLES) ** 2
    bags = F.embedding_bag(
        index.reshape(-1, taps),
        table.rows,
        mode="sum",
        per_sample_weights=weight.reshape(-1, taps).to(table.rows.dtype),
    )
    return bags.reshape(len(every), bins, bins, table.rows.shape[1]).permute(0, 3, 1, 2)


def axis_taps(low: Tensor, high: Tensor, limit: Tensor, bins: int) -> tuple[Tensor, Tensor]:
    """Cells and weights of every bin along one axis, for boxes from ``low`` to ``high`` (R,).

    Returns:
        indices (R, bins, 4) int64 in 0..limit-1 and weights (R, bins, 4), which sum to 1 for a
        bin inside the map. Samples more than one cell outside count as zeros.
    """
    length = (high - low).clamp(min=1.0)
    bin_length = (length / bins)[:, None, None]
    bin_number = torch.arange(bins, device=low.device)[:, None]
    sample = (torch.arange(SAMPLES, device=low.device) + 0.5)[None]
    position = low[:, None, None] + bin_number * bin_length + sample * bin_length / SAMPLES
    last = (limit - 1)[:, None, None]
    inside = (position >= -1) & (position <= last + 1)
    position = torch.minimum(position.clamp(min=0), last)
    first = position.floor()
    fraction = position - first
    index = torch.stack([first.long(), torch.minimum(first.long() + 1, last)], dim=-1)
    weight = torch.stack([1 - fraction, fraction], dim=-1) * inside[..., None] / SAMPLES
    return index.flatten(2), weight.flatten(2)
