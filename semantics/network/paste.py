"""Pasting the masks of boxes into masks of the whole image."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional as F

PADDING = 1
"""Cells of zeros around a mask, so that it fades out at the border of its box."""


def paste(masks: Tensor, boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Probabilities (N, height, width) of masks (N, M, M) inside their boxes (N, 4).

    Bilinear and with pixel centres at half cells, that is s = (u + 0.5) m / w - 0.5 for a mask
    of m cells over w whole pixels. Being separable, it is two matrix products a mask.
    """
    if len(masks) == 0:
        return masks.new_zeros(0, *size)
    padded = F.pad(masks, (PADDING,) * 4)
    whole = _grown(boxes, padded.shape[-1] / masks.shape[-1])
    rows = _interpolation(whole[:, 1], whole[:, 3], padded.shape[1], size[0])
    columns = _interpolation(whole[:, 0], whole[:, 2], padded.shape[2], size[1])
    return rows.to(masks.dtype) @ padded @ columns.to(masks.dtype).transpose(1, 2)


def _grown(boxes: Tensor, factor: float) -> Tensor:
    """Boxes (N, 4) enlarged about their centres, as first and last pixels (rounded to zero)."""
    half = (boxes[:, 2:] - boxes[:, :2]) * 0.5 * factor
    centre = (boxes[:, 2:] + boxes[:, :2]) * 0.5
    return torch.cat([centre - half, centre + half], dim=1).long()


def _interpolation(first: Tensor, last: Tensor, cells: int, pixels: int) -> Tensor:
    """Weights (N, pixels, cells) of linear interpolation; rows outside first..last are zero."""
    length = (last - first + 1).clamp(min=1)[:, None]
    u = torch.arange(pixels, device=first.device) - first[:, None]
    source = ((u + 0.5) * (cells / length) - 0.5).clamp(0, cells - 1)
    cell = torch.arange(cells, device=first.device)
    weight = (1 - (source[..., None] - cell).abs()).clamp(min=0)
    return weight * ((u >= 0) & (u < length))[..., None]
