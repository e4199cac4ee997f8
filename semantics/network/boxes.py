"""Boxes (x1, y1, x2, y2) in pixels of the network's input: coding, clipping, overlap.

Here, as in torchvision, coordinates are those of continuous edges: a box has the width x2 - x1.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_LOG_SCALE = math.log(1000.0 / 16)
"""Logarithm of the largest growth of a box, so that exp cannot overflow."""
RPN_WEIGHTS = (1.0, 1.0, 1.0, 1.0)
BOX_WEIGHTS = (10.0, 10.0, 5.0, 5.0)
"""Factors of the coded (dx, dy, dw, dh), which bring them to about unit variance."""

AT_ONCE = 8192
"""Overlaps are computed for this many boxes at a time, so that intermediates stay in the cache."""

Weights = tuple[float, float, float, float]


def area(boxes: Tensor) -> Tensor:
    """(..., 4) to (...)."""
    return (boxes[..., 2] - boxes[..., 0]) * (boxes[..., 3] - boxes[..., 1])


def encode(targets: Tensor, references: Tensor, weights: Weights) -> Tensor:
    """Offsets (N, 4) that move the reference boxes (N, 4) to the targets (N, 4).

    dx = w_x (x_t - x_r) / width_r, dw = w_w log(width_t / width_r), with centres x
    (Girshick et al. 2014, appendix C).
    """
    sizes_r, sizes_t = references[:, 2:] - references[:, :2], targets[:, 2:] - targets[:, :2]
    centres_r, centres_t = references[:, :2] + 0.5 * sizes_r, targets[:, :2] + 0.5 * sizes_t
    factors = targets.new_tensor(weights)
    shift = (centres_t - centres_r) / sizes_r
    return torch.cat([shift, torch.log(sizes_t / sizes_r)], dim=1) * factors


def decode(offsets: Tensor, references: Tensor, weights: Weights) -> Tensor:
    """Boxes (N, K, 4) from offsets (N, K, 4) to each of the reference boxes (N, 4)."""
    sizes = (references[:, 2:] - references[:, :2])[:, None]
    centres = references[:, None, :2] + 0.5 * sizes
    scaled = offsets / offsets.new_tensor(weights)
    new_centres = scaled[..., :2] * sizes + centres
    half = 0.5 * (torch.exp(scaled[..., 2:].clamp(max=MAX_LOG_SCALE)) * sizes)
    return torch.cat([new_centres - half, new_centres + half], dim=-1)


def clip(boxes: Tensor, size: tuple[int, int]) -> Tensor:
    """Boxes (..., 4) clipped to an image of (height, width)."""
    height, width = size
    upper = boxes.new_tensor([width, height, width, height])
    return torch.minimum(boxes.clamp(min=0), upper)


def mirrored(boxes: Tensor, width: float) -> Tensor:
    """Boxes (..., 4) in the image mirrored left to right."""
    x1, y1, x2, y2 = boxes.unbind(-1)
    return torch.stack([width - x2, y1, width - x1, y2], dim=-1)


def enlarged(boxes: Tensor, factor: float) -> Tensor:
    """Boxes (N, 4) grown by a factor about their centres, also beyond the image."""
    if factor == 1.0:
        return boxes
    grow = (boxes[:, 2:] - boxes[:, :2]) * (0.5 * (factor - 1))
    return torch.cat([boxes[:, :2] - grow, boxes[:, 2:] + grow], dim=1)


def at_least(boxes: Tensor, min_px: float) -> Tensor:
    """Whether boxes (N, 4) are at least ``min_px`` wide and high; (N,) bool."""
    return ((boxes[:, 2:] - boxes[:, :2]) >= min_px).all(dim=1)


def rescale(boxes: Tensor, old: tuple[int, int], new: tuple[int, int]) -> Tensor:
    """Boxes (N, 4) of an image of (height, width) ``old`` in the same image resized to ``new``."""
    y, x = (
        torch.tensor(float(n), device=boxes.device) / torch.tensor(float(o), device=boxes.device)
        for n, o in zip(new, old, strict=True)
    )
    return boxes * torch.stack([x, y, x, y])


def iou(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4)."""
    return torch.cat([_iou(a, part) for part in b.split(AT_ONCE)], dim=1)


def _iou(a: Tensor, b: Tensor) -> Tensor:
    widths, heights = (_overlap(a[:, k], a[:, k + 2], b[:, k], b[:, k + 2]) for k in (0, 1))
    intersection = widths.mul_(heights)
    union = (area(a)[:, None] + area(b)[None, :]).sub_(intersection)
    return intersection / union


def _overlap(low_a: Tensor, high_a: Tensor, low_b: Tensor, high_b: Tensor) -> Tensor:
    """Length (N, M) of the intersection of intervals (N,) and (M,)."""
    high = torch.minimum(high_a[:, None], high_b.contiguous()[None])
    return high.sub_(torch.maximum(low_a[:, None], low_b.contiguous()[None])).clamp_(min=0)
