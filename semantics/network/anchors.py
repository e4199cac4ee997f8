"""Anchors: boxes of fixed shapes at every cell of every pyramid level, for the RPN."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from bmask_slam.semantics.network.config import AnchorConfig


def cell_anchors(
    size_px: float, ratios: Sequence[float], device: torch.device | None = None
) -> Tensor:
    """Boxes (R, 4) of one size around the origin, rounded to whole pixels."""
    heights = torch.sqrt(torch.tensor(ratios, device=device))
    widths = 1 / heights
    half = torch.stack([widths, heights], dim=1) * size_px
    return (torch.cat([-half, half], dim=1) / 2).round()


def make_anchors(
    levels: Sequence[Tensor], image_size: tuple[int, int], config: AnchorConfig
) -> list[Tensor]:
    """Anchors (H_l * W_l * count, 4) of each level (B, C, H_l, W_l): rows, columns, then shapes.

    The distance of two anchors is the padded image's (height, width) over the level's, rounded
    down: at the coarsest level that may be less than the stride (torchvision does the same).
    """
    anchors = []
    for level, size_px in zip(levels, config.sizes_px, strict=True):
        rows, columns = level.shape[-2:]
        step_y, step_x = image_size[0] // rows, image_size[1] // columns
        y = torch.arange(rows, device=level.device) * step_y
        x = torch.arange(columns, device=level.device) * step_x
        centres = torch.cartesian_prod(y, x).flip(1).repeat(1, 2)
        shapes = cell_anchors(size_px, config.ratios, level.device)
        small = cell_anchors(size_px / 2, config.half_ratios, level.device)
        anchors.append((centres[:, None] + torch.cat([shapes, small])).reshape(-1, 4))
    return anchors
