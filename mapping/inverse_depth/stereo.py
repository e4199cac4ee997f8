"""Step 2 for rectified stereo pairs: disparities in the search range, with a left-right check."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.matching_cost import (
    GuidedFilter,
    MatchingConfig,
    matching_cost,
    winner,
)

MAX_DIFFERENCE_PX = 1.0


def match_stereo(
    left: Tensor,
    right: Tensor,
    camera: Camera,
    search_range: tuple[float, float],
    config: MatchingConfig | None = None,
) -> InverseDepthMap:
    """Inverse depth of the left image of a rectified pair (3, H, W), u_right = u_left - d.

    Costs are summed by a guided filter. The least cost within ``search_range`` (1/m), extended by
    one pixel of disparity at both ends, is chosen. It is dropped at an end of the range, where it
    is no minimum, and if the match of the right image differs by more than a pixel.
    sigma_rho = sigma_d / (f b) with sigma_d = 1 px.
    """
    bf, config = camera.stereo_bf_px_m, config or MatchingConfig()
    first = max(math.floor(search_range[0] * bf) - 1, 0)
    last = math.ceil(search_range[1] * bf) + 1
    disparities = range(first, last + 1)
    costs = _summed(left, right, disparities, config)
    mirrored = _summed(right.flip(-1), left.flip(-1), disparities, config)
    disparity = winner(costs)[0] + first
    other = (winner(mirrored)[0] + first).flip(-1)
    inner = (disparity > max(first, 0.5)) & (disparity < last)
    known = inner & left_right_consistent(disparity, other)
    rho = torch.where(known, disparity / bf, torch.nan)
    return InverseDepthMap(rho, torch.where(known, bf**-2, torch.nan))


def _summed(image: Tensor, other: Tensor, disparities: range, config: MatchingConfig) -> Tensor:
    """Costs (D, H, W) of the other image shifted right by each disparity."""
    moved = [pad(other, (d, 0), value=torch.nan)[..., : other.shape[-1]] for d in disparities]
    costs = [matching_cost(image, m, config) for m in moved]
    return GuidedFilter(image, config)(torch.stack(costs))


def left_right_consistent(disparity: Tensor, other: Tensor) -> Tensor:
    """Pixels (H, W) of the left image whose match in the right image has the same disparity."""
    columns = torch.arange(disparity.shape[1], device=disparity.device)
    at = torch.round(columns - disparity).long()
    inside = (at >= 0) & (at < disparity.shape[1])
    matched = other.gather(1, at.clamp(0, disparity.shape[1] - 1))
    return inside & ((disparity - matched).abs() <= MAX_DIFFERENCE_PX)
