"""Inverse-depth maps: what is known of a keyframe's surfaces, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Floats, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.pixelwise import gate

COMPATIBLE = 5.99
"""Chi-square with 2 degrees of freedom at 95 %."""


@dataclass(frozen=True, eq=False)
class InverseDepthMap:
    """Independent Gaussians over inverse depth, one a pixel.

    Attributes:
        rho: (H, W) float32, 1 / z in 1/m, NaN where nothing is known.
        variance: (H, W) float32 in 1/m^2, NaN in the same places.
    """

    rho: Tensor
    variance: Tensor

    @property
    def known(self) -> Tensor:
        """(H, W) bool."""
        return self.rho.abs() < torch.inf

    def where(self, keep: Tensor) -> InverseDepthMap:
        """The same, with everything outside ``keep`` (H, W) unknown."""
        missing = torch.full_like(self.rho, torch.nan)
        return InverseDepthMap(
            torch.where(keep, self.rho, missing), torch.where(keep, self.variance, missing)
        )

    def without(self, hidden: Mask) -> InverseDepthMap:
        """The same, with everything in ``hidden`` (H, W) unknown."""
        return self.where(torch.from_numpy(~hidden).to(self.rho.device))

    def depth_m(self) -> Floats:
        """Depth (H, W) in metres, NaN where missing."""
        return np.asarray((1 / self.rho).cpu().numpy(), np.float32)

    def depth_sigma_m(self) -> Floats:
        """Standard deviation of the depth (H, W) in metres, to first order: sigma_rho / rho^2."""
        sigma = torch.sqrt(self.variance) / self.rho**2
        return np.asarray(sigma.cpu().numpy(), np.float32)


@dataclass(frozen=True)
class DepthNoise:
    """How a depth sensor errs.

    Attributes:
        disparity_sigma_px: of the disparity bf / z; for structured light a constant.
        lateral_sigma_px: how far from a pixel's centre its depth may have been taken.
        min_depth_m, max_depth_m: depth outside is taken for missing.
    """

    disparity_sigma_px: float = 0.08
    lateral_sigma_px: float = 0.35
    min_depth_m: float = 0.3
    max_depth_m: float = 8.0


def from_sensor(
    depth_m: Floats, camera: Camera, noise: DepthNoise, device: str = "cpu"
) -> InverseDepthMap:
    """The measurement of a depth sensor as an inverse-depth map.

    rho = d / (f b) with d ~ N(d0, sigma_d^2) gives sigma_rho^2 = (sigma_d / (f b))^2 (paper eq. 6,
    corrected), to which the lateral error adds (sigma_lateral |grad rho|)^2.
    """
    z = torch.as_tensor(depth_m, dtype=torch.float32, device=device)
    usable = torch.minimum(z - noise.min_depth_m, noise.max_depth_m - z)
    rho = z.reciprocal().add_(gate(usable))
    disparity = (noise.disparity_sigma_px / camera.stereo_bf_px_m) ** 2
    variance = squared_gradient(rho).mul_(noise.lateral_sigma_px**2).add_(disparity)
    return InverseDepthMap(rho, variance)


def squared_gradient(rho: Tensor) -> Tensor:
    """|grad rho|^2 (H, W) per pixel^2, NaN where rho is.

    Central differences; where a neighbour is missing that direction counts as flat.
    """
    squared = rho * 0
    squared[:, 1:-1] += (rho[:, 2:] - rho[:, :-2]).div_(2).nan_to_num_().square_()
    squared[1:-1] += (rho[2:] - rho[:-2]).div_(2).nan_to_num_().square_()
    return squared


def agreement(difference: Tensor, weight: Tensor, worth: float = 1.0) -> Tensor:
    """``worth`` where difference^2 weight < 5.99, else 0; the difference is overwritten.

    ``weight`` is 1 / sigma_x^2 + 1 / sigma_y^2.
    """
    distance = difference.square_().mul_(weight)
    steep = 2.0**100
    return torch.rsub(distance, COMPATIBLE * steep, alpha=steep).clamp_(0, worth)
