"""Step 4: a keyframe's map fused with what its neighbours know of the same surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations

import numpy as np
import torch
from torch import Tensor

from graph.camera import Camera
from graph.geometry import inverse
from mapping.inverse_depth import COMPATIBLE, InverseDepthMap, squared_gradient
from mapping.regularisation import set_order
from mapping.warping import View, hypothesis, moved, project

MAX_NEIGHBOURS = 6
MAX_COLOUR_STEP = 15.0
MEDIAN_CHI2 = 0.455
SAMPLE_STEP, MIN_SAMPLE = 4, 200
FACTOR_RANGE = (0.25, 20.0)
"""Errors that all views share are not seen in their differences: it is never very small."""
BLUR_PX = 0.43
MAX_SMOOTHED = 0.9
WRONG_SIDE = 0.03
"""Measured on the rendered rooms' silhouettes."""
RIM_STEP, RIM_PX = 1.05, 2
"""So near to a surface, seeded or not, that is nearer by this factor nothing is seeded: it may be
its rim."""


@dataclass(frozen=True, eq=False)
class Fused:
    """What Step 4 makes of a keyframe.

    Attributes:
        map: the fused estimates.
        views: (H, W) uint8, how many keyframes each rests on, its own among them.
        factor: see ``variance_factor``.
    """

    map: InverseDepthMap
    views: Tensor
    factor: float


def fuse(
    own: InverseDepthMap,
    neighbours: Sequence[View],
    camera: Camera,
    image: Tensor | None = None,
) -> Fused:
    """Fuse a map with up to six neighbours' by paper eq. (8) over compatible hypotheses.

    Each neighbour gives one hypothesis a pixel (`mapping.warping.hypothesis`) about the point at
    rho_0: the own estimate, or where there is none the nearest surface that the neighbours see
    there. Of the own estimate and the hypotheses the largest mutually compatible set is fused,
    rho = sum(rho_j / sigma_j^2) / sum(1 / sigma_j^2) and sigma^2 = 1 / sum(1 / sigma_j^2), since
    these are independent views. An own estimate that nobody shares stays, unless a neighbour
    sees through it; a surface that only one neighbour shows is not taken, nor, where there are
    images (3, H, W), one that has another colour there.
    """
    views = neighbours[:MAX_NEIGHBOURS]
    seeds = seeded(own, views, camera)
    empty = ~own.known
    hypotheses = [hypothesis(torch.where(empty, seeds, own.rho), v, camera, empty) for v in views]
    factor = variance_factor(own, hypotheses)
    rho, weight = [own.rho], [_weight(own.variance)]
    through = torch.zeros_like(empty)
    for view, (mean, variance) in zip(views, hypotheses, strict=True):
        if image is not None and view.image is not None:
            drop_other_colours(seeds, variance, (image, view), camera)
        weight.append(_weight(variance))
        rho.append(torch.where(weight[-1] > 0, mean, torch.nan))
        through |= rho[-1] < own.rho
    members = compatible_members(rho, weight)
    alone = (members == 0) & ~empty & ~through
    members += alone
    total, norm = torch.zeros_like(seeds), torch.zeros_like(seeds)
    count = torch.zeros_like(members)
    for k, (rho_k, weight_k) in enumerate(zip(rho, weight, strict=True)):
        used = (members >> k) & 1
        count += used
        share = weight_k * used
        norm += share
        total.addcmul_(share, torch.nan_to_num(rho_k))
    norm = torch.where(members > 0, norm, torch.nan)
    return Fused(InverseDepthMap(total / norm, 1 / norm), count, factor)


def variance_factor(own: InverseDepthMap, hypotheses: Sequence[tuple[Tensor, Tensor]]) -> float:
    """By how much the variances (H, W) that views state must be multiplied to agree with them.

    The squared difference of two views over sigma_0^2 + sigma_j^2 has the median 0.455 if both are
    right. Step 3 states the least variance of correlated neighbours, which is too large, an error
    of the relative pose makes it too small. The median of all neighbours' factors.
    """
    factors, step = [], (slice(None, None, SAMPLE_STEP),) * 2
    for mean, variance in hypotheses:
        ratio = (own.rho[step] - mean[step]) ** 2 / (own.variance[step] + variance[step])
        ratio = ratio[torch.isfinite(ratio)]
        if len(ratio) >= MIN_SAMPLE:
            factors.append(float(ratio.median()) / MEDIAN_CHI2)
    return float(np.clip(np.median(factors), *FACTOR_RANGE)) if factors else 1.0


def stated(final: InverseDepthMap, before: Fused) -> InverseDepthMap:
    """A map after Step 5 with its honest variance, by what Step 4 made.

    It is what both Steps state times ``before.factor``, less what Step 5 smoothed away: at least
    var(after - before), as for means over all neighbours; over compatible ones it is more.
    Steps 3 and 5 and the reading between pixels move a depth in the image by BLUR_PX, which adds
    (BLUR_PX |grad rho|)^2. On the rim of a silhouette a share WRONG_SIDE of the estimates belongs
    to the surface on the other side, which adds that share of the squared step.
    """
    variance = before.factor * final.variance
    variance *= 1 - _smoothed_away(final, before)
    variance += BLUR_PX**2 * squared_gradient(final.rho)
    rows, columns, step = rim_steps(final)
    variance[rows, columns] += WRONG_SIDE * step**2
    return InverseDepthMap(final.rho, variance)


def _smoothed_away(final: InverseDepthMap, before: Fused) -> float:
    """Share of the variance, by the median change of the estimates."""
    step = (slice(None, None, SAMPLE_STEP),) * 2
    change = (final.rho[step] - before.map.rho[step]) ** 2 / before.map.variance[step]
    change = change[torch.isfinite(change)]
    if len(change) < MIN_SAMPLE:
        return 0.0
    return min(float(change.median()) / (MEDIAN_CHI2 * before.factor), MAX_SMOOTHED)


def rim_steps(given: InverseDepthMap) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns (N,) of estimates beside a hole, and how far others within two pixels are.

    The third is the greatest |rho_j - rho| (N,) of the 5x5 pixels around.
    """
    known = given.known
    share = torch.nn.functional.avg_pool2d(
        known[None].to(torch.float32), 3, 1, 1, count_include_pad=False
    )[0]
    rows, columns = torch.nonzero(known & (share < 0.99)).unbind(-1)
    padded = torch.nn.functional.pad(given.rho, (2, 2, 2, 2), value=torch.nan)
    around = torch.arange(5, device=padded.device)
    window = padded[rows[:, None, None] + around[:, None], columns[:, None, None] + around]
    steps = torch.nan_to_num(window - given.rho[rows, columns][:, None, None]).abs()
    return rows, columns, steps.amax((1, 2))


def drop_other_colours(
    seeds: Tensor, variance: Tensor, images: tuple[Tensor, View], camera: Camera
) -> None:
    """Make the hypotheses NaN in place whose surface has another colour in the neighbour."""
    own, view = images
    assert view.image is not None
    rows, columns = torch.nonzero(torch.isfinite(seeds) & torch.isfinite(variance)).unbind(-1)
    pixels = (columns.to(torch.float32), rows.to(torch.float32))
    u, v, _ = project(seeds[rows, columns], inverse(view.T_own_neighbour), camera, pixels)
    height, width = seeds.shape
    u, v = u.round().clamp(0, width - 1).long(), v.round().clamp(0, height - 1).long()
    apart = (own[:, rows, columns] - view.image[:, v, u]).abs().amax(0)
    other = apart > MAX_COLOUR_STEP
    variance[rows[other], columns[other]] = torch.nan


def _weight(variance: Tensor) -> Tensor:
    """1 / sigma^2, 0 where nothing is known."""
    return torch.nan_to_num(1 / variance, nan=0.0, posinf=0.0)


def seeded(own: InverseDepthMap, views: Sequence[View], camera: Camera) -> Tensor:
    """Inverse depth (H, W) of the nearest surface that neighbours see where ``own`` has none."""
    height, width = own.rho.shape
    seeds = torch.zeros(height * width, dtype=torch.float32, device=own.rho.device)
    empty = ~own.known.reshape(-1)
    if not empty.any():
        return torch.full_like(own.rho, torch.nan)
    for view in views:
        u, v, ahead = project(view.map.rho, view.T_own_neighbour, camera)
        column, row = u.round_(), v.round_()
        inside = ahead & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        target = torch.where(inside, row * width + column, 0.0).to(torch.int32).reshape(-1)
        landing = empty.index_select(0, target) & inside.reshape(-1)
        chosen = torch.nonzero(landing)[:, 0]
        pixels = ((chosen % width).to(torch.float32), (chosen // width).to(torch.float32))
        rho, _ = moved(view.map.rho.reshape(-1)[chosen], view.T_own_neighbour, camera, pixels)
        seeds.scatter_reduce_(0, target[chosen].to(torch.int64), rho, "amax")
    seeds = seeds.reshape(height, width)
    around = torch.nn.functional.max_pool2d(
        torch.maximum(torch.nan_to_num(own.rho), seeds)[None], 5, 1, 2
    )[0]
    return torch.where((seeds > 0) & (around < RIM_STEP * seeds), seeds, torch.nan)


def compatible_members(rho: Sequence[Tensor], weight: Sequence[Tensor]) -> Tensor:
    """Bit masks (H, W) uint8 of the largest mutually compatible sets of two or more estimates.

    ``rho`` and ``weight`` hold one (H, W) for each of up to seven keyframes, rho NaN where it says
    nothing. 0 where no two are compatible; of equal sets the one with early members.
    """
    pairs = list(combinations(range(len(rho)), 2))
    code = torch.zeros(rho[0].shape, dtype=torch.int32, device=rho[0].device)
    for k, (i, j) in enumerate(pairs):
        distance = (rho[i] - rho[j]).square_().mul_(weight[i] + weight[j])
        code.add_(distance < COMPATIBLE, alpha=1 << k)
    table = _largest_sets(len(rho)).to(code.device)
    return table.index_select(0, code.reshape(-1)).reshape(code.shape)


@cache
def _largest_sets(n: int) -> Tensor:
    """For every set of compatible pairs, as a bit mask, the largest set of members."""
    pairs = list(combinations(range(n), 2))
    codes = np.arange(1 << len(pairs), dtype=np.int32)
    table = np.zeros(len(codes), np.uint8)
    for subset in reversed(set_order(n)):
        needed = sum(1 << k for k, (i, j) in enumerate(pairs) if subset >> i & subset >> j & 1)
        table[codes & needed == needed] = subset
    return torch.from_numpy(table)
