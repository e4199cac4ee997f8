"""A cloud for each object, written block by block as the map's cloud is."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.graph.files.whole_file import remove
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.semantics.objects.boxes3d import OrientedBox

MARGIN_M = 0.03
"""Added to a box on each side, which was fitted to some of the object's points only."""


@dataclass(frozen=True, eq=False)
class ObjectRegion:
    """An object: the name of its file, its label and its box in the world."""

    name: str
    label: int
    box: OrientedBox


def assign_regions(cloud: Cloud, regions: Sequence[ObjectRegion]) -> Ints:
    """The index (N,) of each point's region, -1 for none.

    Of the regions with the point's label whose boxes contain it, it is the one with the nearest
    centre.
    """
    found = np.full(len(cloud), -1, np.int64)
    nearest: Array = np.full(len(cloud), np.inf)
    for k, region in enumerate(regions):
        same = np.flatnonzero(cloud.labels == region.label)
        points = cloud.points[same].astype(float)
        wide = OrientedBox(region.box.T_world_box, region.box.size_m + 2 * MARGIN_M)
        distance = np.linalg.norm(points - region.box.T_world_box[:3, 3], axis=1)
        inside = wide.contains(points) & (distance < nearest[same])
        found[same[inside]], nearest[same[inside]] = k, distance[inside]
    return found


class ObjectClouds(ExitStack):
    """Writes FOLDER/NAME.ply, and .pcd, for every region with points; a context manager."""

    def __init__(self, folder: Path, regions: Sequence[ObjectRegion], pcd: bool = False) -> None:
        super().__init__()
        self.folder, self.regions, self._pcd = folder, regions, pcd
        self._writers: dict[int, CloudWriter] = {}

    def __enter__(self) -> Self:
        remove(self.folder)
        return super().__enter__()

    def write(self, cloud: Cloud) -> None:
        """Append a block of the map's cloud."""
        found = assign_regions(cloud, self.regions)
        for k in np.unique(found[found >= 0]).tolist():
            if k not in self._writers:
                self.folder.mkdir(exist_ok=True)
                writer = CloudWriter(self.folder / self.regions[k].name, pcd=self._pcd)
                self._writers[k] = self.enter_context(writer)
            self._writers[k].write(cloud.select(found == k))

    @property
    def files(self) -> list[Path]:
        """The PLY files, in the order of the regions."""
        return [self._writers[k].stem.with_suffix(".ply") for k in sorted(self._writers)]
