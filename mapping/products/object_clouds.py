"""A cloud for each object, filled as blocks of the map's cloud arrive."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from pathlib import Path
from types import TracebackType

import numpy as np

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.semantics.objects.boxes3d import OrientedBox

MARGIN_M = 0.03
"""Around a box: it was made of some of the object's points only."""


@dataclass(frozen=True, eq=False)
class ObjectRegion:
    """Where an object is: its file's name, its label and the box around it in the world."""

    name: str
    label: int
    box: OrientedBox


def owners(cloud: Cloud, regions: Sequence[ObjectRegion]) -> Ints:
    """The region (N,) of each point, -1 for none: of those with its label whose box holds it, the
    one whose centre is nearest.
    """
    found = np.full(len(cloud), -1, np.int64)
    nearest: Array = np.full(len(cloud), np.inf)
    for k, region in enumerate(regions):
        same = np.flatnonzero(cloud.labels == region.label)
        points = cloud.points[same].astype(float)
        wide = OrientedBox(region.box.T_world_box, region.box.size_m + 2 * MARGIN_M)
        away = np.linalg.norm(points - region.box.T_world_box[:3, 3], axis=1)
        mine = wide.contains(points) & (away < nearest[same])
        found[same[mine]], nearest[same[mine]] = k, away[mine]
    return found


class ObjectClouds:
    """Writes FOLDER/NAME.ply and .pcd of every region that has points; a context manager."""

    def __init__(self, folder: Path, regions: Sequence[ObjectRegion]) -> None:
        self.folder, self.regions = folder, regions
        self._stack = ExitStack()
        self._writers: dict[int, CloudWriter] = {}

    def __enter__(self) -> ObjectClouds:
        shutil.rmtree(self.folder, ignore_errors=True)
        return self

    def write(self, cloud: Cloud) -> None:
        """Take a block in."""
        found = owners(cloud, self.regions)
        for k in np.unique(found[found >= 0]).tolist():
            if k not in self._writers:
                self.folder.mkdir(exist_ok=True)
                writer = CloudWriter(self.folder / self.regions[k].name)
                self._writers[k] = self._stack.enter_context(writer)
            rows = found == k
            part = {f.name: getattr(cloud, f.name)[rows] for f in fields(Cloud)}
            self._writers[k].write(Cloud(**part))

    @property
    def files(self) -> list[Path]:
        """What is written, by the regions' order."""
        return [self._writers[k].stem.with_suffix(".ply") for k in sorted(self._writers)]

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(kind, error, traceback)
