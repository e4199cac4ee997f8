"""The options of a dense map: what it is made of, and how."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.errors import InputError
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseConfig, DepthSource, check_device
from bmask_slam.mapping.inverse_depth.depth_map import MeasurementConfig
from bmask_slam.semantics.beliefs.movability import read_priors
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

VOXEL_RANGE_M = (0.001, 1.0)
MIN_MOVABILITY = 0.5
"""Classes that are likelier to move than this are excluded by default."""


@dataclass(frozen=True)
class MapOptions:
    """What is mapped, and how.

    Attributes:
        run: folder of a finished run.
        sequence: folder of its images, if they have moved.
        masks: the segmenter; None: the one of the run.
        excluded: classes that are not mapped because they move; None: those whose prior
            probability to move is above one half.
        keep_excluded: write the points of excluded classes to a cloud of their own.
        voxel_m: the surface, and so the cloud, has at most one point in a cube with this edge.
        mesh_voxel_m: the same in place of ``voxel_m``, for a preview; finished keyframes are kept.
        source: where depth comes from, see `mapping.inverse_depth.dense_mapper.DenseConfig`.
        device: torch's name of the device that computes the fusion.
        mesh, plan: whether to make them.
        pcd: write clouds as PCD too.
        keep_volume: keep the surface's volume, so that the next map only integrates what moved.
    """

    run: Path
    sequence: Path | None = None
    masks: SegmenterOptions | None = None
    excluded: tuple[str, ...] | None = None
    keep_excluded: bool = False
    voxel_m: float = 0.01
    mesh_voxel_m: float | None = None
    source: DepthSource = "sensor"
    device: str = "cpu"
    mesh: bool = False
    plan: bool = False
    pcd: bool = False
    keep_volume: bool = False

    @property
    def surface_voxel_m(self) -> float:
        """Edge of the surface's voxels."""
        return self.voxel_m if self.mesh_voxel_m is None else self.mesh_voxel_m


def check_voxels(options: MapOptions) -> None:
    """Raise InputError for a voxel size that is out of range."""
    low, high = VOXEL_RANGE_M
    for voxel_m in (options.voxel_m, options.surface_voxel_m):
        if not low <= voxel_m <= high:
            raise InputError(f"voxel {voxel_m} m: must be between {low:g} and {high:g}")


def resolve_options(options: MapOptions, labels: LabelSet) -> MapOptions:
    """The options, checked, with ``excluded`` filled in.

    Raises:
        InputError: the voxel size is out of range, torch has no such device, or an excluded class
            is not in ``labels``.
    """
    check_device(options.device)
    check_voxels(options)
    excluded = options.excluded
    if excluded is None:
        movability = read_priors("movability").of(labels)
        excluded = tuple(labels.names[k] for k in np.flatnonzero(movability > MIN_MOVABILITY))
    for name in excluded:
        if labels.number(name) == 0:
            known = ", ".join(labels.names[1:]) or "none, give --segmenter or --masks"
            raise InputError(f"--without {name!r}: no such class; there are: {known}")
    return replace(options, excluded=excluded)


def fusion_config(options: MapOptions) -> DenseConfig:
    """The configuration of the fusion, with the run's own noise model of its depth sensor."""
    features = resolve(FeatureConfig, options.run / "config.yaml", section="features")
    measurement = MeasurementConfig(
        disparity_sigma_px=features.disparity_sigma_px, max_depth_m=features.max_depth_m
    )
    return DenseConfig(measurement=measurement, source=options.source, device=options.device)
