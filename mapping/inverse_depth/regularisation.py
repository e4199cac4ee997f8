"""Steps 3 and 5: outliers of a map are removed and holes filled from the eight neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.pixelwise import (
    COMPATIBLE,
    agreement,
    nan_where_negative,
    windowed,
)

OFFSETS = tuple((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0))
MIN_SUPPORT = 2
FAR = 1e6
"""Inverse depth of missing pixels: compatible with no estimate."""
FILL_SUPPORT = 5
"""The paper has 2, which also fills the rim of silhouettes, from the side with more pixels."""


def regularise(given: InverseDepthMap, fill_support: int = FILL_SUPPORT) -> InverseDepthMap:
    """The map smoothed, without outliers, and with the rims of its holes filled.

    Neighbours x and y are compatible where (rho_x - rho_y)^2 (1/sigma_x^2 + 1/sigma_y^2) < 5.99. A
    pixel with fewer than two compatible neighbours is dropped; else it and they are fused by
    paper eq. (7), corrected: rho = sum(rho_j / sigma_j^2) / sum(1 / sigma_j^2). The variance is the
    least of the set, since neighbours are correlated. An empty pixel is filled in the same way
    from the largest set of mutually compatible neighbours, if that has ``fill_support``.
    """
    rho = torch.nan_to_num(given.rho, nan=FAR)
    weight = torch.nan_to_num(1 / given.variance)
    rhos, weights = _padded(rho, FAR), _padded(weight)
    count, total = torch.zeros_like(rho), rho * weight
    norm, best = weight.clone(), weight.clone()

    def accumulate(agreeing: Tensor, offset: tuple[int, int]) -> None:
        """Add the neighbours at an offset where they agree (H, W)."""
        share = agreeing * _shifted(weights, offset)
        count.add_(agreeing)
        norm.add_(share)
        total.addcmul_(share, _shifted(rhos, offset))
        torch.maximum(best, share, out=best)

    for dy, dx in OFFSETS[:4]:  # agreement is symmetric
        both = weight + _shifted(weights, (dy, dx))
        agreeing = agreement(rho - _shifted(rhos, (dy, dx)), both)
        accumulate(agreeing, (dy, dx))
        accumulate(_shifted(_padded(agreeing), (-dy, -dx)), (-dy, -dx))
    rho = total.div_(norm).add_(nan_where_negative(count.sub_(MIN_SUPPORT)))
    cleaned = InverseDepthMap(rho, best.reciprocal_().add_(0 * rho))
    return _filled(cleaned, rhos, weights, fill_support)


def _padded(values: Tensor, rim: float = 0.0) -> Tensor:
    """Values (H, W) with a rim of one pixel."""
    return torch.nn.functional.pad(values, (1, 1, 1, 1), value=rim)


def _shifted(padded: Tensor, offset: tuple[int, int]) -> Tensor:
    """The view (H, W) of every pixel's neighbour at an offset (rows, columns)."""
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    dy, dx = offset
    return padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]


def _filled(
    cleaned: InverseDepthMap, rhos: Tensor, weights: Tensor, support: int
) -> InverseDepthMap:
    """``cleaned`` with the holes of the given map filled from their neighbours.

    ``rhos`` and ``weights`` are those of the given map with a rim.
    """
    known = weights[1:-1, 1:-1].sign()
    around = windowed(torch.add, known, 1).sub_(known, alpha=len(OFFSETS) + 1)
    rows, columns = torch.nonzero(around >= support).unbind(-1)
    rho_j, weight_j = (
        torch.stack([_shifted(padded, offset)[rows, columns] for offset in OFFSETS], dim=-1)
        for padded in (rhos, weights)
    )
    members = largest_compatible_set(rho_j, weight_j)
    weight_j = weight_j * members
    enough = members.sum(-1) >= support
    rows, columns, weight_j, rho_j = (a[enough] for a in (rows, columns, weight_j, rho_j))
    cleaned.rho[rows, columns] = (weight_j * rho_j).sum(-1) / weight_j.sum(-1)
    cleaned.variance[rows, columns] = 1 / weight_j.amax(-1)
    return cleaned


def largest_compatible_set(rho: Tensor, weight: Tensor) -> Tensor:
    """Members (N, 8) bool of the largest set of mutually compatible estimates in each row.

    ``rho`` (N, 8) with weights 1 / sigma^2 (N, 8), 0 where there is none. Of equally large sets
    the first in the order of `set_order` is taken; a single estimate is no set.
    """
    distance = (rho[:, :, None] - rho[:, None]) ** 2 * (weight[:, :, None] + weight[:, None])
    valid = weight > 0
    apart = valid[:, :, None] & valid[:, None] & ~(distance < COMPATIBLE)
    members = valid & (valid.sum(-1, keepdim=True) > 1)
    conflicting = torch.nonzero(apart.any((1, 2)))[:, 0]
    members[conflicting] = _largest_by_trial(apart[conflicting], valid[conflicting])
    return members


def _largest_by_trial(apart: Tensor, valid: Tensor) -> Tensor:
    """The same by trying all sets; pairs ``apart`` (N, 8, 8) are incompatible."""
    n = valid.shape[-1]
    sets = [[s >> i & 1 for i in range(n)] for s in set_order(n)]
    tried = torch.tensor(sets, dtype=torch.float32, device=valid.device)
    pairs = (tried[:, :, None] * tried[:, None]).reshape(-1, n * n)
    clashes = apart.reshape(-1, n * n).to(torch.float32) @ pairs.T
    clashes += (~valid).to(torch.float32) @ tried.T
    free, first = (clashes == 0).to(torch.uint8).max(-1)
    return (tried[first] * free[:, None]) > 0


def set_order(n: int) -> list[int]:
    """Sets of two to n members as bit masks: larger ones first, then those with early members."""
    subsets = [s for s in range(1, 1 << n) if s.bit_count() > 1]
    return sorted(subsets, key=lambda s: (-s.bit_count(), [-(s >> i & 1) for i in range(n)]))
