"""Steps 3 and 5: outliers of a map removed and its holes filled by the eight neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from mapping.inverse_depth import COMPATIBLE, InverseDepthMap

OFFSETS = tuple((dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0))
MIN_SUPPORT = 2
FAR = 1e6
"""Stands for what is missing: compatible with no estimate."""
FILL_SUPPORT = 5
"""The paper's 2 also fills the rim of silhouettes, from whichever side has more pixels."""


def regularise(given: InverseDepthMap, fill_support: int = FILL_SUPPORT) -> InverseDepthMap:
    """A map smoothed, cleaned and completed at the rims of its holes.

    Neighbours x and y are compatible where (rho_x - rho_y)^2 (1/sigma_x^2 + 1/sigma_y^2) < 5.99. A
    pixel with fewer than two compatible neighbours is dropped; else it and they are fused by
    paper eq. (7), corrected: rho = sum(rho_j / sigma_j^2) / sum(1 / sigma_j^2). The variance is the
    least of the set, since neighbours are correlated. An empty pixel is filled in the same way
    from the largest set of mutually compatible neighbours, if that has ``fill_support``.
    """
    rho = torch.nan_to_num(given.rho, nan=FAR)
    weight = _weight(given)
    rhos, weights = _padded(rho, FAR), _padded(weight)
    count = torch.zeros_like(rho)
    total, norm, best = rho * weight, weight.clone(), weight.clone()
    for offset in OFFSETS:
        rho_j, weight_j = _shifted(rhos, offset), _shifted(weights, offset)
        agreeing = (rho - rho_j).square_().mul_(weight + weight_j) < COMPATIBLE
        count += agreeing
        share = agreeing * weight_j
        norm += share
        total.addcmul_(share, rho_j)
        torch.maximum(best, share, out=best)
    cleaned = InverseDepthMap(total / norm, 1 / best).where(given.known & (count >= MIN_SUPPORT))
    return _filled(given, cleaned, fill_support)


def _padded(values: Tensor, rim: float = 0.0) -> Tensor:
    """With a rim one pixel wide."""
    return torch.nn.functional.pad(values, (1, 1, 1, 1), value=rim)


def _shifted(padded: Tensor, offset: tuple[int, int]) -> Tensor:
    """The view (H, W) of every pixel's neighbour at an offset (rows, columns)."""
    height, width = padded.shape[0] - 2, padded.shape[1] - 2
    dy, dx = offset
    return padded[1 + dy : 1 + dy + height, 1 + dx : 1 + dx + width]


def _filled(given: InverseDepthMap, cleaned: InverseDepthMap, support: int) -> InverseDepthMap:
    """``cleaned``, with what was empty in ``given`` filled from its neighbours there."""
    known = given.known
    around = torch.nn.functional.avg_pool2d(
        known[None].to(torch.float32), 3, 1, 1, divisor_override=1
    )[0]
    rows, columns = torch.nonzero(~known & (around >= support)).unbind(-1)
    rho_j, weight_j = (
        torch.stack([_shifted(padded, offset)[rows, columns] for offset in OFFSETS], dim=-1)
        for padded in (_padded(torch.nan_to_num(given.rho)), _padded(_weight(given)))
    )
    members = largest_compatible_set(rho_j, weight_j)
    weight_j = weight_j * members
    enough = members.sum(-1) >= support
    rows, columns, weight_j, rho_j = (a[enough] for a in (rows, columns, weight_j, rho_j))
    rho, variance = cleaned.rho.clone(), cleaned.variance.clone()
    rho[rows, columns] = (weight_j * rho_j).sum(-1) / weight_j.sum(-1)
    variance[rows, columns] = 1 / weight_j.amax(-1)
    return InverseDepthMap(rho, variance)


def _weight(given: InverseDepthMap) -> Tensor:
    """1 / sigma^2, 0 where nothing is known."""
    return torch.nan_to_num(1 / given.variance)


def largest_compatible_set(rho: Tensor, weight: Tensor) -> Tensor:
    """Members (N, 8) bool of the largest set of mutually compatible estimates in each row.

    ``rho`` (N, 8) with weights 1 / sigma^2 (N, 8), 0 where there is none. Of equally large sets
    the first in the order of `set_order` is taken; one alone is no set.
    """
    n = rho.shape[-1]
    distance = (rho[:, :, None] - rho[:, None]) ** 2 * (weight[:, :, None] + weight[:, None])
    there = weight > 0
    pairs = (distance < COMPATIBLE) & there[:, :, None] & there[:, None]
    bits = 1 << torch.arange(n, device=rho.device)
    clashing = (~pairs * bits).sum(-1) & ~bits  # (N, n): who cannot be with member i
    clean = [torch.ones(len(rho), dtype=torch.bool, device=rho.device)]
    chosen = torch.zeros(len(rho), dtype=torch.int64, device=rho.device)
    for subset in range(1, 1 << n):
        lowest = (subset & -subset).bit_length() - 1
        clean.append(clean[subset & (subset - 1)] & ((clashing[:, lowest] & subset) == 0))
    for subset in set_order(n):
        chosen = torch.where((chosen == 0) & clean[subset], subset, chosen)
    return (chosen[:, None] & bits) != 0


def set_order(n: int) -> list[int]:
    """Sets of two to n members as bit masks: larger ones first, then those of early members."""
    subsets = [s for s in range(1, 1 << n) if s.bit_count() > 1]
    return sorted(subsets, key=lambda s: (-s.bit_count(), [-(s >> i & 1) for i in range(n)]))
