"""Step 4: a keyframe's map is fused with its neighbours' maps of the same surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, reduce
from itertools import combinations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.pixelwise import (
    agreement,
    nan_where_negative,
    squared_gradient,
    windowed,
)
from bmask_slam.mapping.inverse_depth.regularisation import FAR, set_order
from bmask_slam.mapping.inverse_depth.warping import View, hypothesis, project

MAX_NEIGHBOURS = 6
MAX_COLOUR_STEP = 15.0
MEDIAN_CHI2 = 0.455
SAMPLE_STEP, MIN_SAMPLE = 4, 200
FACTOR_RANGE = (0.25, 20.0)
"""The lower bound is not small: errors that all views share do not show in their differences."""
BLUR_PX = 0.43
MAX_SMOOTHED = 0.9
WRONG_SIDE = 0.03
"""Share of estimates on the rim of a silhouette that belong to the other side; measured."""
RIM_STEP, RIM_PX = 1.05, 2
"""No hole is seeded within so many pixels of a surface that is nearer by this factor, since the
pixel may belong to that surface's rim."""


@dataclass(frozen=True, eq=False)
class Fused:
    """The result of Step 4 for a keyframe.

    Attributes:
        map: the fused estimates.
        views: (H, W) uint8, number of keyframes in each estimate, its own included.
        factor: see ``variance_factor``.
    """

    map: InverseDepthMap
    views: Tensor
    factor: float


def fuse(
    own: InverseDepthMap, neighbours: Sequence[View], camera: Camera, image: Tensor | None = None
) -> Fused:
    """Fuse a map with those of up to six neighbours by paper eq. (8) over compatible hypotheses.

    Each neighbour gives one hypothesis a pixel (`mapping.inverse_depth.warping.hypothesis`) about
    the point at rho_0: the own estimate, or where there is none the nearest surface that the
    neighbours see there. Of the own estimate and the hypotheses the largest mutually compatible set
    is fused, rho = sum(rho_j / sigma_j^2) / sum(1 / sigma_j^2) and
    sigma^2 = 1 / sum(1 / sigma_j^2), since these are independent views. An own estimate that is
    compatible with no hypothesis stays, unless a neighbour sees a farther surface through it. A
    hole is not filled by a single neighbour, nor, where there are images (3, H, W), by a surface
    with another colour in the neighbour.
    """
    views, known = neighbours[:MAX_NEIGHBOURS], own.known
    seeds = hole_seeds(own, views, camera)
    points, empty = torch.where(known, own.rho, seeds), torch.isnan(own.rho).to(torch.float32)
    hypotheses = [hypothesis(points, view, camera, empty) for view in views]
    factor = variance_factor(own, hypotheses)
    if image is not None:
        reject_other_colours(seeds, [v for _, v in hypotheses], image, views, camera)
    rho = [_without_nan(own.rho, FAR)]
    rho += [_without_nan(r + 0 * v, FAR * k) for k, (r, v) in enumerate(hypotheses, 2)]
    weight = [_without_nan(1 / v, 1.0) for v in (own.variance, *(v for _, v in hypotheses))]
    members = compatible_members(rho, weight)
    in_free_space = reduce(torch.minimum, rho) < own.rho
    members += (members == 0) & known & ~in_free_space
    return Fused(*_fused(rho, weight, members), factor)


def _fused(
    rho: Sequence[Tensor], weight: Sequence[Tensor], members: Tensor
) -> tuple[InverseDepthMap, Tensor]:
    """The members (H, W), as bit masks, of the estimates fused, and their number (H, W)."""
    total, norm, count = (torch.zeros_like(rho[0]) for _ in range(3))
    for k, (rho_k, weight_k) in enumerate(zip(rho, weight, strict=True)):
        used = (members >> k).bitwise_and_(1).to(torch.float32)
        count += used
        share = used.mul_(weight_k)
        norm += share
        total.addcmul_(share, rho_k)
    total /= norm
    fused = InverseDepthMap(total, norm.reciprocal_().add_(0 * total))
    return fused, count.to(torch.uint8)


def _without_nan(values: Tensor, missing: float) -> Tensor:
    return torch.nan_to_num(values, nan=missing, posinf=0.0)


def variance_factor(own: InverseDepthMap, hypotheses: Sequence[tuple[Tensor, Tensor]]) -> float:
    """The factor by which the views' variances (H, W) must be multiplied to fit their differences.

    The squared difference of two views over sigma_0^2 + sigma_j^2 has the median 0.455 if both
    variances are right. Step 3 gives the least variance of correlated neighbours, which is too
    large; an error of the relative pose makes the variance too small. The factor is the median over
    the neighbours.
    """
    factors, step = [], (slice(None, None, SAMPLE_STEP),) * 2
    own_rho, own_variance = own.rho[step], own.variance[step]
    for mean, variance in hypotheses:
        ratio = (mean[step] - own_rho).square_().div_(variance[step] + own_variance)
        if int(torch.isfinite(ratio).sum()) >= MIN_SAMPLE:
            factors.append(float(ratio.nanmedian()) / MEDIAN_CHI2)
    return float(np.clip(np.median(factors), *FACTOR_RANGE)) if factors else 1.0


def with_calibrated_variance(final: InverseDepthMap, before: Fused) -> InverseDepthMap:
    """The map after Step 5 with a consistent variance, from the result of Step 4.

    It is the variance of the Steps times ``before.factor``, less the part that Step 5 smoothed
    away, which is at least var(after - before) as for means over all neighbours. Steps 3 and 5 and
    the interpolation between pixels move a depth in the image by BLUR_PX, which adds
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
    """Share of the variance that Step 5 removed, by the median change of the estimates."""
    step = (slice(None, None, SAMPLE_STEP),) * 2
    change = (final.rho[step] - before.map.rho[step]) ** 2 / before.map.variance[step]
    change = change[torch.isfinite(change)]
    if len(change) < MIN_SAMPLE:
        return 0.0
    return min(float(change.median()) / (MEDIAN_CHI2 * before.factor), MAX_SMOOTHED)


def rim_steps(given: InverseDepthMap) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns (N,) of estimates beside a hole, and the largest step (N,) near each.

    The step is the largest |rho_j - rho| over the 5x5 pixels around.
    """
    around = windowed(torch.add, given.rho, 1)  # NaN beside a hole
    rows, columns = torch.nonzero(given.known & torch.isnan(around)).unbind(-1)
    own = given.rho[rows, columns]
    most = windowed(torch.maximum, torch.nan_to_num(given.rho, nan=-torch.inf), 2, -torch.inf)
    least = windowed(torch.minimum, torch.nan_to_num(given.rho, nan=torch.inf), 2, torch.inf)
    steps = torch.maximum(most[rows, columns] - own, own - least[rows, columns])
    return rows, columns, steps


def reject_other_colours(
    seeds: Tensor, variances: Sequence[Tensor], image: Tensor, views: Sequence[View], camera: Camera
) -> None:
    """Make the views' variances (H, W) NaN in place where a seed has another colour in the view."""
    height, width = seeds.shape
    chosen = torch.nonzero(seeds.reshape(-1) > 0)[:, 0]
    pixels = (chosen % width).to(torch.float32), (chosen // width).to(torch.float32)
    seed = seeds.reshape(-1).index_select(0, chosen)
    colours = image.reshape(3, -1).index_select(1, chosen)
    for view, variance in zip(views, variances, strict=True):
        if view.image is None:
            continue
        u, v, _ = project(seed, inverse(view.T_own_neighbour), camera, pixels)
        u, v = u.round_().clamp_(0, width - 1), v.round_().clamp_(0, height - 1)
        place = u.add_(v, alpha=width).nan_to_num_().to(torch.int32)
        sampled = view.image.reshape(3, -1).index_select(1, place)
        apart = (colours - sampled).abs_().amax(0)
        variance.view(-1).index_add_(0, chosen, nan_where_negative(MAX_COLOUR_STEP - apart))


def hole_seeds(own: InverseDepthMap, views: Sequence[View], camera: Camera) -> Tensor:
    """Inverse depth (H, W) of the nearest surface that neighbours see where ``own`` has none."""
    height, width = own.rho.shape
    empty = pad(torch.isnan(own.rho), (1, 1, 1, 1)).reshape(-1)
    seeds = torch.zeros((height + 2) * (width + 2), device=own.rho.device)
    for view in views:
        u, v, w = project(view.map.rho, view.T_own_neighbour, camera)
        column, row = u.round_().clamp_(-1, width), v.round_().clamp_(-1, height)
        place = row.add_(1).mul_(width + 2).add_(column).add_(1).nan_to_num_()
        target = place.to(torch.int32).reshape(-1)
        chosen = torch.nonzero(empty.index_select(0, target))[:, 0]
        rho = view.map.rho.reshape(-1)[chosen] / w.reshape(-1)[chosen]
        seeds.scatter_reduce_(0, target[chosen].to(torch.int64), rho, "amax")
    seeds = seeds.reshape(height + 2, width + 2)[1:-1, 1:-1]
    around = windowed(torch.maximum, torch.maximum(torch.nan_to_num(own.rho), seeds), RIM_PX)
    return torch.where((seeds > 0) & (around < RIM_STEP * seeds), seeds, torch.nan)


def compatible_members(rho: Sequence[Tensor], weight: Sequence[Tensor]) -> Tensor:
    """Bit masks (H, W) uint8 of the largest mutually compatible sets of two or more estimates.

    ``rho`` and ``weight`` hold one (H, W) for each of up to seven keyframes; where one has no
    estimate its rho is far from all others. 0 where no two are compatible; of equally large sets
    the one with early members.
    """
    code = torch.zeros_like(rho[0])  # holds 21 bits without loss
    for k, (i, j) in enumerate(combinations(range(len(rho)), 2)):
        code += agreement(rho[i] - rho[j], weight[i] + weight[j], 1 << k)
    table = _largest_sets(len(rho)).to(code.device)
    return table.index_select(0, code.to(torch.int32).reshape(-1)).reshape(code.shape)


@cache
def _largest_sets(n: int) -> Tensor:
    """The largest set of members for every set of compatible pairs, both as bit masks."""
    pairs = list(combinations(range(n), 2))
    codes = np.arange(1 << len(pairs), dtype=np.int32)
    table = np.zeros(len(codes), np.uint8)
    for subset in reversed(set_order(n)):
        needed = sum(1 << k for k, (i, j) in enumerate(pairs) if subset >> i & subset >> j & 1)
        table[codes & needed == needed] = subset
    return torch.from_numpy(table)
