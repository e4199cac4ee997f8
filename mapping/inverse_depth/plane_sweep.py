"""Step 2 between keyframes: a plane sweep over inverse depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.matching_cost import (
    GuidedFilter,
    MatchingConfig,
    matching_cost,
    winner,
)
from bmask_slam.mapping.inverse_depth.warping import project


@dataclass(frozen=True)
class SweepConfig:
    """Constants of the plane sweep.

    Attributes:
        levels: number of inverse depths, evenly spaced over the search range.
        shrink: factor by which the images are made smaller.
        min_distinctness: of the best match; below it the match is ambiguous.
        max_cost: of the best match.
        matching: constants of the costs.
    """

    levels: int = 48
    shrink: int = 2
    min_distinctness: float = 1.15
    max_cost: float = 2.5
    matching: MatchingConfig = field(default_factory=lambda: MatchingConfig(guided_radius=4))


def sweep(
    image: Tensor,
    neighbours: Sequence[tuple[Tensor, Array]],
    camera: Camera,
    search_range: tuple[float, float],
    config: SweepConfig | None = None,
) -> InverseDepthMap:
    """Inverse depth (H, W) of an image (3, H, W) from neighbours (image, T_own_neighbour).

    At each level every neighbour is warped by the plane z = 1 / rho; the cost is that of the
    neighbour which agrees best, since the point may be occluded in the others. The level with the
    least cost wins, refined to a fraction of a level. sigma_rho is the change of inverse depth that
    moves a pixel of the small image by one, 1 / |dp / d rho|, in the neighbour that moves most.
    """
    config = config or SweepConfig()
    small = shrunk_camera(camera, config.shrink)
    guide = _shrunk(image, config.shrink)
    others = [(_shrunk(other, config.shrink), inverse(T)) for other, T in neighbours]
    levels = torch.linspace(*search_range, config.levels, device=image.device)
    planes = [_level(guide, others, small, float(rho), config.matching) for rho in levels]
    costs = GuidedFilter(guide, config.matching)(torch.stack(planes))
    index, distinctness = winner(costs)
    good = (distinctness > config.min_distinctness) & (costs.amin(0) < config.max_cost)
    good &= (index > 0) & (index < config.levels - 1)
    step = (search_range[1] - search_range[0]) / (config.levels - 1)
    rho = torch.where(good, search_range[0] + index * step, torch.nan)
    moved = torch.stack([_motion(rho, T, small) for _, T in others]).amax(0)
    found = InverseDepthMap(rho, torch.where(moved > 0, moved**-2, torch.nan))
    return _enlarged(found.where(moved > 0), image.shape[-2:])


def _level(
    guide: Tensor,
    others: Sequence[tuple[Tensor, Array]],
    camera: Camera,
    rho: float,
    config: MatchingConfig,
) -> Tensor:
    """Costs (h, w) of one inverse depth: the least over the neighbours."""
    plane = torch.full(guide.shape[-2:], rho, device=guide.device)
    costs = []
    for other, T_other_own in others:
        u, v, _ = project(plane, T_other_own, camera)
        inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
        grid = torch.stack(
            [u * (2 / (camera.width - 1)) - 1, v * (2 / (camera.height - 1)) - 1], dim=-1
        )[None]
        warped = grid_sample(other[None], grid, "bilinear", "border", align_corners=True)[0]
        costs.append(matching_cost(guide, torch.where(inside, warped, torch.nan), config))
    return torch.stack(costs).amin(0)


def _motion(rho: Tensor, T_other_own: Array, camera: Camera) -> Tensor:
    """|dp / d rho| (h, w) of the pixel in the neighbour, by a finite difference."""
    step = 1e-3
    u, v, _ = project(rho, T_other_own, camera)
    u2, v2, _ = project(rho + step, T_other_own, camera)
    return torch.nan_to_num(torch.hypot(u2 - u, v2 - v) / step, posinf=0.0)


def shrunk_camera(camera: Camera, by: int) -> Camera:
    """The camera of images averaged over by x by pixels: (u + 0.5) / by - 0.5."""
    return Camera(
        camera.width // by, camera.height // by, camera.fx / by, camera.fy / by,
        (camera.cx + 0.5) / by - 0.5, (camera.cy + 0.5) / by - 0.5,
        stereo_bf_px_m=camera.stereo_bf_px_m / by,
    )  # fmt: skip


def _shrunk(image: Tensor, by: int) -> Tensor:
    return avg_pool2d(image[None], by)[0]


def _enlarged(small: InverseDepthMap, shape: Sequence[int]) -> InverseDepthMap:
    """A map of a larger shape (H, W) in which every pixel has the estimate of its block.

    What is left beyond the last whole block has that of the last one.
    """
    rows, columns = (
        torch.arange(whole, device=small.rho.device)
        .div(whole // kept, rounding_mode="floor")
        .clamp(max=kept - 1)
        for whole, kept in zip(shape, small.rho.shape, strict=True)
    )
    rho, variance = (x[rows][:, columns] for x in (small.rho, small.variance))
    return InverseDepthMap(rho, variance)


def fill_missing(measured: InverseDepthMap, matched: InverseDepthMap) -> InverseDepthMap:
    """The measurement where there is one, the match of images elsewhere."""
    known = measured.known
    return InverseDepthMap(
        torch.where(known, measured.rho, matched.rho),
        torch.where(known, measured.variance, matched.variance),
    )
