"""Step 2: matching costs of two images under a hypothesis, summed by a guided filter.

Images are (3, H, W) float32, 0 to 255. A hypothesis is the other image warped to this one's
pixels, NaN where it has none.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad


@dataclass(frozen=True)
class MatchingConfig:
    """Constants of the costs (Hosni et al. 2013).

    Attributes:
        alpha: weight of the gradient's cost.
        max_colour, max_gradient: at which the two costs are truncated.
        guided_radius, guided_epsilon: of the guided filter, the latter for colours 0 to 1.
    """

    alpha: float = 0.9
    max_colour: float = 30.0
    max_gradient: float = 2.0
    guided_radius: int = 9
    guided_epsilon: float = 1e-3


def matching_cost(image: Tensor, other: Tensor, config: MatchingConfig) -> Tensor:
    """Costs (H, W) of the pixels under one hypothesis.

    (1 - alpha) min(mean |dI|, max_colour) + alpha min(|d grad_x I|, max_gradient); the largest
    possible where the other image is NaN.
    """
    colour = (image - other).abs().mean(0).clamp(max=config.max_colour)
    slope = (_slope(image) - _slope(other)).abs().clamp(max=config.max_gradient)
    cost = (1 - config.alpha) * colour + config.alpha * slope
    worst = (1 - config.alpha) * config.max_colour + config.alpha * config.max_gradient
    return torch.nan_to_num(cost, nan=worst)


def _slope(image: Tensor) -> Tensor:
    """Half the difference of a pixel's right and left neighbours (H, W) in grey; 0 at the sides."""
    grey = image.mean(0)
    return pad((grey[:, 2:] - grey[:, :-2]) / 2, (1, 1))


class GuidedFilter:
    """Edge-preserving means of costs: He et al. 2010, with a grey guide."""

    def __init__(self, image: Tensor, config: MatchingConfig) -> None:
        self._radius = config.guided_radius
        self._guide = image.mean(0) / 255
        self._mean = self._box(self._guide)
        variance = self._box(self._guide**2) - self._mean**2
        self._scale = 1 / (variance + config.guided_epsilon)

    def __call__(self, cost: Tensor) -> Tensor:
        """The filtered costs of (D, H, W) or (H, W)."""
        mean = self._box(cost)
        slope = (self._box(self._guide * cost) - self._mean * mean) * self._scale
        offset = mean - slope * self._mean
        return self._box(slope) * self._guide + self._box(offset)

    def _box(self, values: Tensor) -> Tensor:
        """Means over the part of the window that is inside the image."""
        r, planes = self._radius, values.reshape(-1, 1, *values.shape[-2:])
        size = (2 * r + 1, 1)
        for kernel, rim in ((size, (r, 0)), (size[::-1], (0, r))):
            planes = avg_pool2d(planes, kernel, 1, rim, count_include_pad=False)
        return planes.reshape(values.shape)


def winner(costs: Tensor) -> tuple[Tensor, Tensor]:
    """Index (H, W) of the least of costs (D, H, W), with its fraction, and its distinctness (H, W).

    The fraction is that of the parabola through the least cost and its two neighbours. The
    distinctness is the ratio of the least cost beyond these neighbours to the least of all.
    """
    best, index = costs.min(0)
    count = len(costs)
    before = costs.gather(0, (index - 1).clamp(min=0)[None])[0]
    after = costs.gather(0, (index + 1).clamp(max=count - 1)[None])[0]
    bend = before + after - 2 * best
    inner = (index > 0) & (index < count - 1) & (bend > 1e-9)
    shift = torch.where(inner, (before - after) / (2 * bend).clamp(min=1e-9), 0.0)
    levels = torch.arange(count, device=costs.device)[:, None, None]
    rival = torch.where((levels - index).abs() > 1, costs, torch.inf).amin(0)
    return index + shift, rival / best.clamp(min=1e-9)
