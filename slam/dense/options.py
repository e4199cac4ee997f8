"""What a dense map is made of, and how."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bmask_slam.mapping.inverse_depth.dense_mapper import DepthSource
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions


@dataclass(frozen=True)
class MapOptions:
    """What is mapped, and how.

    Attributes:
        run: folder of a finished run.
        sequence: its images, if they have moved.
        masks: what finds the instances; None: what found them in the run.
        without: classes that are left out of the map, since they move; None: those that are
            likelier to move than not.
        moving: keep what is left out in a cloud of its own.
        voxel_m: at most one point in a cube of this edge.
        source: where depth comes from, see `mapping.inverse_depth.dense_mapper.DenseConfig`.
        device: torch's name of where depth is fused.
        mesh, plan: whether to make them.
    """

    run: Path
    sequence: Path | None = None
    masks: SegmenterOptions | None = None
    without: tuple[str, ...] | None = None
    moving: bool = False
    voxel_m: float = 0.01
    source: DepthSource = "sensor"
    device: str = "cpu"
    mesh: bool = False
    plan: bool = False
