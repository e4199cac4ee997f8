"""Arithmetic on whole images, which a processor does several times faster than it chooses.

Masks are float32 here, 1 or 0, and what does not count is made NaN by adding a `gate`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import pad, threshold

SLACK = 1e-30


def gate(margin: Tensor) -> Tensor:
    """0 where a finite margin is not negative, NaN elsewhere."""
    return threshold(margin, -SLACK, torch.nan).mul_(0)


def windowed(
    combine: Callable[[Tensor, Tensor], Tensor], values: Tensor, radius: int, beyond: float = 0.0
) -> Tensor:
    """What ``combine`` (sum, maximum) makes of the square window around each pixel of (..., H, W).

    ``beyond`` is what the window finds outside the image.
    """
    height, width = values.shape[-2:]
    padded = pad(values, (radius,) * 4, value=beyond)
    across = reduce(combine, (padded[..., k : k + width] for k in range(2 * radius + 1)))
    return reduce(combine, (across[..., k : k + height, :] for k in range(2 * radius + 1)))
