"""Step 2 for rectified stereo pairs: disparities in the search range, checked from both sides."""

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
    support_weighted,
    winner,
)

MAX_DIFFERENCE_PX = 1.0


def match_stereo(
    left: Tensor,
    right: Tensor,
    camera: Camera,
    search_range: tuple[float, float],
    exact: bool = False,
    config: MatchingConfig | None = None,
) -> InverseDepthMap:
    """Inverse depth of the left image of a rectified pair (3, H, W), u_right = u_left - d.

    Costs are summed by a guided filter, or with ``exact`` by adaptive support weights; the winner
    takes all within ``search_range`` (1/m) and a pixel around it; what wins at the rim of that is
    no minimum and is dropped, as is what the right image's winner does not confirm within a pixel.
    sigma_rho = sigma_d / (f b) with sigma_d = 1 px.
    """
    bf, config = camera.stereo_bf_px_m, config or MatchingConfig()
    first = max(math.floor(search_range[0] * bf) - 1, 0)
    last = math.ceil(search_range[1] * bf) + 1
    costs = _summed(left, right, range(first, last + 1), (config, exact))
    mirrored = _summed(right.flip(-1), left.flip(-1), range(first, last + 1), (config, exact))
    disparity = winner(costs)[0] + first
    other = (winner(mirrored)[0] + first).flip(-1)
    inner = (disparity > max(first, 0.5)) & (disparity < last)
    known = inner & checked(disparity, other)
    rho = torch.where(known, disparity / bf, torch.nan)
    return InverseDepthMap(rho, torch.where(known, bf**-2, torch.nan))


def _summed(
    image: Tensor, other: Tensor, disparities: range, how: tuple[MatchingConfig, bool]
) -> Tensor:
    """Costs (D, H, W) of the other image moved right by each disparity."""
    config, exact = how
    moved = [pad(other, (d, 0), value=torch.nan)[..., : other.shape[-1]] for d in disparities]
    costs = [matching_cost(image, m, config) for m in moved]
    if exact:
        pairs = zip(costs, moved, strict=True)
        return torch.stack([support_weighted(c, image, m, config) for c, m in pairs])
    return GuidedFilter(image, config)(torch.stack(costs))


def checked(disparity: Tensor, other: Tensor) -> Tensor:
    """Pixels (H, W) of the left image whose match in the right image has their disparity too."""
    columns = torch.arange(disparity.shape[1], device=disparity.device)
    at = torch.round(columns - disparity).long()
    inside = (at >= 0) & (at < disparity.shape[1])
    there = other.gather(1, at.clamp(0, disparity.shape[1] - 1))
    return inside & ((disparity - there).abs() <= MAX_DIFFERENCE_PX)
