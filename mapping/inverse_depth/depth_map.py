"""Inverse-depth maps: the inverse depth of a keyframe's pixels with its variance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bmask_slam.graph.arrays import Floats, Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import FileKind, check_like, read_arrays, write_arrays
from bmask_slam.mapping.inverse_depth.pixelwise import nan_where_negative, squared_gradient

DEPTH_FILE = FileKind("fused depth", 1, compressed=True)
RHO_STEP, SIGMA_STEP, MAX_STEPS = 1 / 16000, 1e-6, 65535
"""Units of the stored integers in 1/m: rho up to 4, far finer than sigma, and sigma up to 0.065."""


@dataclass(frozen=True, eq=False)
class InverseDepthMap:
    """Independent Gaussians over inverse depth, one a pixel.

    Attributes:
        rho: (H, W) float32, 1 / z in 1/m, NaN where it is unknown.
        variance: (H, W) float32 in 1/m^2, NaN in the same places.
    """

    rho: Tensor
    variance: Tensor

    @property
    def known(self) -> Tensor:
        """(H, W) bool."""
        return self.rho.abs() < torch.inf

    def where(self, keep: Tensor) -> InverseDepthMap:
        """The same map, unknown outside ``keep`` (H, W)."""
        missing = torch.full_like(self.rho, torch.nan)
        return InverseDepthMap(
            torch.where(keep, self.rho, missing), torch.where(keep, self.variance, missing)
        )

    def without(self, hidden: Mask) -> InverseDepthMap:
        """The same map, unknown in ``hidden`` (H, W)."""
        return self.where(torch.from_numpy(~hidden).to(self.rho.device))

    def cpu(self) -> InverseDepthMap:
        """The same map in the memory of the processor."""
        return InverseDepthMap(self.rho.cpu(), self.variance.cpu())

    def depth_m(self) -> Floats:
        """Depth (H, W) in metres, NaN where missing."""
        return np.asarray((1 / self.rho).cpu().numpy(), np.float32)

    def depth_sigma_m(self) -> Floats:
        """Standard deviation of the depth (H, W) in metres, to first order: sigma_rho / rho^2."""
        sigma = torch.sqrt(self.variance) / self.rho**2
        return np.asarray(sigma.cpu().numpy(), np.float32)


@dataclass(frozen=True)
class MeasurementConfig:
    """What of a depth image is used, and how certain it is.

    Attributes:
        disparity_sigma_px: of the disparity bf / z; None: the noise of depth is the camera's.
        lateral_sigma_px: distance from a pixel's centre at which its depth may have been measured.
        min_depth_m, max_depth_m: depth outside this range counts as missing.
    """

    disparity_sigma_px: float | None = None
    lateral_sigma_px: float = 0.35
    min_depth_m: float = 0.3
    max_depth_m: float = 8.0


def from_sensor(
    depth_m: Floats, camera: Camera, config: MeasurementConfig, device: str = "cpu"
) -> InverseDepthMap:
    """The measurement (H, W) of a depth sensor as an inverse-depth map.

    rho = d / (f b) with d ~ N(d0, sigma_d^2) gives sigma_rho^2 = (sigma_d / (f b))^2 (paper eq. 6,
    corrected), or another sensor's own, to which the lateral error adds
    (sigma_lateral |grad rho|)^2.
    """
    z = torch.as_tensor(depth_m, dtype=torch.float32, device=device)
    usable = torch.minimum(z - config.min_depth_m, config.max_depth_m - z)
    rho = z.reciprocal().add_(nan_where_negative(usable))
    noise = camera.noise_of_depth(config.disparity_sigma_px)
    sensor = noise.inverse_depth_sigma(rho.cpu().numpy().astype(float)) ** 2
    variance = squared_gradient(rho).mul_(config.lateral_sigma_px**2)
    variance += torch.as_tensor(sensor, dtype=torch.float32, device=device)
    return InverseDepthMap(rho, variance)


def write_depth_map(path: Path, given: InverseDepthMap) -> None:
    """Save a map, quantised; the file appears whole or not at all.

    What is nearer than 0.25 m, which the file cannot hold, is unknown in it.

    Raises:
        InputError: it cannot be written.
    """
    given = given.where(given.rho < MAX_STEPS * RHO_STEP)
    arrays = {
        "rho": _quantised(given.rho, RHO_STEP),
        "sigma": _quantised(torch.sqrt(given.variance), SIGMA_STEP),
    }
    write_arrays(path, DEPTH_FILE, {}, arrays)


def read_depth_map(path: Path) -> InverseDepthMap:
    """Read a map. Raises InputError for a missing, foreign or broken file."""
    arrays = read_arrays(path, DEPTH_FILE)[1]
    none = np.zeros((0, 0), np.uint16)
    check_like(arrays, {"rho": none, "sigma": none}, path)
    if arrays["rho"].shape != arrays["sigma"].shape:
        raise InputError(f"{path}: rho and sigma differ in size; make it again")
    known = arrays["rho"] > 0
    rho, sigma = (
        np.where(known, arrays[name] * np.float32(step), np.float32(np.nan))
        for name, step in (("rho", RHO_STEP), ("sigma", SIGMA_STEP))
    )
    return InverseDepthMap(torch.from_numpy(rho), torch.from_numpy(sigma**2))


def _quantised(values: Tensor, step: float) -> NDArray[np.uint16]:
    """Multiples of a step, at least 1, 0 where NaN."""
    steps = torch.nan_to_num(torch.round(values / step).clamp(1, MAX_STEPS))
    return np.asarray(steps.cpu().numpy(), np.uint16)
