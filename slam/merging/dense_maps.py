"""The dense maps of merged runs: keyframes that are fused are taken over, the surface is made anew.

A keyframe's fused depth is in its own camera frame and stays right when its pose changes a little,
as after `bmask-slam optimise`.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shlex import quote

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.map_run import MapSummary, map_run, open_fusion
from bmask_slam.dense.options import MapOptions
from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.errors import InputError
from bmask_slam.merging.sources import Source
from bmask_slam.world.landmark_table import LandmarkTable

logger = logging.getLogger(__name__)


def merge_dense_maps(
    run: Path, sources: Sequence[Source], landmarks: LandmarkTable
) -> MapSummary | None:
    """The dense map of a merged run, if all runs have one that was made in the same way.

    Else, or if it cannot be made (a full disk), the log says why. ``landmarks`` know the fusions.
    """
    having = [source for source in sources if (source.path / "dense" / "settings.json").is_file()]
    if len(having) < len(sources):
        if having:
            logger.warning(
                "no dense map: only %d of the runs have one; %s", len(having), _cure(run)
            )
        return None
    try:
        parts = [DenseFolder.reading(source.path) for source in sources]
        if not all(part.is_like(parts[0]) for part in parts):
            raise InputError("the runs' dense maps were made with different settings")
        first = sources[0].path / "dense"
        options = MapOptions(
            run,
            excluded=tuple(parts[0].settings["without"]),
            keep_excluded=bool(parts[0].settings["moving"]),
            voxel_m=float(parts[0].settings["voxel_m"]),
            source=parts[0].settings["source"],
            mesh=(first / "mesh.ply").is_file(),
            plan=(first / "plan.png").is_file(),
        )
        folder = open_fusion(options).folder
        for source, part in zip(sources, parts, strict=True):
            if folder.is_like(part):
                ids = source.state["mapper.world.keyframes.id"]
                new_ids = dict(zip(ids.tolist(), source.shift.keyframe(ids).tolist(), strict=True))
                new_landmarks = partial(_present_ids, source, landmarks)
                taken = folder.take_over(part, new_ids, new_landmarks)
                logger.info("%s: %d fused keyframes taken over", part.path, taken)
        return map_run(options)
    except (InputError, OSError, KeyError, TypeError, ValueError, IndexError) as error:
        logger.warning("no dense map: %s; %s", error, _cure(run))
        return None


def _cure(run: Path) -> str:
    return f"make it by: bmask-slam map {quote(str(run))}"


def _present_ids(source: Source, landmarks: LandmarkTable, ids: Ints) -> Ints:
    """The ids in the merged map of a run's landmarks."""
    return landmarks.current(source.shift.landmark(ids))
