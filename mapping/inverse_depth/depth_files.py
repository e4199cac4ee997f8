"""Fused inverse depth on disk, quantised."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from bmask_slam.graph.files.array_file import FileKind, read_arrays, write_arrays
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap

DEPTH_FILE = FileKind("fused depth", 1)
RHO_STEP, SIGMA_STEP = 1 / 16000, 1e-6
"""Of the stored integers in 1/m: rho up to 4, far finer than its sigma, which is up to 0.065."""


def write_fused(path: Path, fused: InverseDepthMap) -> None:
    """Save a map; it appears whole or not at all. Raises InputError where it cannot."""
    arrays = {
        "rho": _quantised(fused.rho, RHO_STEP),
        "sigma": _quantised(torch.sqrt(fused.variance), SIGMA_STEP),
    }
    write_arrays(path, DEPTH_FILE, {}, arrays)


def read_fused(path: Path) -> InverseDepthMap:
    """Read a map. Raises InputError for a missing, foreign or broken file."""
    arrays = read_arrays(path, DEPTH_FILE)[1]
    known = arrays["rho"] > 0
    rho, sigma = (
        np.where(known, arrays[name] * np.float32(step), np.float32(np.nan))
        for name, step in (("rho", RHO_STEP), ("sigma", SIGMA_STEP))
    )
    return InverseDepthMap(torch.from_numpy(rho), torch.from_numpy(sigma**2))


def _quantised(values: torch.Tensor, step: float) -> NDArray[np.uint16]:
    """Multiples of a step, at least 1, 0 where NaN."""
    steps = torch.nan_to_num(torch.round(values / step).clamp(1, 65535))
    return np.asarray(steps.cpu().numpy(), np.uint16)
