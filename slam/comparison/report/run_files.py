"""Times of the stages, events and pictures of the maps, from run folders."""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from bmask_slam.comparison.experiment.result import Cell, CellStatus, Comparison, Kind
from bmask_slam.comparison.report.table import EMPTY
from bmask_slam.events import EventKind, read_events
from bmask_slam.graph.errors import InputError
from bmask_slam.reporting.parts import Entry, Picture, Table, TableRow, slug
from bmask_slam.reporting.picture_files import read_picture
from bmask_slam.run_folder.frame_file import FRAMES, STAGES, read_frames

KEYFRAME_STAGES = ("keyframe", "graph", "loops", "semantics")
PICTURE_WIDTH_PX = 900
MAP_PICTURES = {
    "dense/view_overview.png": "the dense map",
    "dense/view_overview_semantic.png": "the dense map in the colours of its labels",
    "dense/view_mesh.png": "the surface",
    "dense/plan.png": "the floor plan",
    "objects.png": "landmarks by label and the objects, from above",
}
Times = dict[str, list[float]]

logger = logging.getLogger(__name__)


def stage_table(comparison: Comparison, folder: Path) -> Table | None:
    """Milliseconds of each stage by method over all its runs; None without a frames.csv."""
    rows = []
    for method in comparison.methods:
        times: Times = defaultdict(list)
        for cell in comparison.cells:
            if cell.method == method.name and method.kind is Kind.RUN:
                read_stage_times(cell, folder, times)
        if times:
            rows.append(TableRow(method.name, tuple(_times_entry(times[s]) for s in STAGES)))
    caption = (
        "Milliseconds, median and 95 % over all frames of all runs; "
        f"{', '.join(KEYFRAME_STAGES)} over keyframes."
    )
    return (
        Table("stages", "Time of each stage (ms)", caption, STAGES, tuple(rows)) if rows else None
    )


def event_table(comparison: Comparison, sequence: str, folder: Path) -> Table | None:
    """Events of each kind by method, mean over its runs; None if nothing happened."""
    counted: dict[str, tuple[Counter[EventKind], int]] = {}
    for method in comparison.methods:
        cells = [c for c in comparison.of(sequence, method.name) if c.status is CellStatus.DONE]
        runs = [folder / c.folder for c in cells if c.folder and method.kind is Kind.RUN]
        if runs:
            counts = Counter(event.kind for run in runs for event in read_events(run))
            counted[method.name] = (counts, len(runs))
    kinds = [kind for kind in EventKind if any(counts[kind] for counts, _ in counted.values())]
    rows = [
        TableRow(name, tuple(Entry(f"{counts[kind] / runs:.3g}") for kind in kinds))
        for name, (counts, runs) in counted.items()
    ]
    name, columns = f"events-{slug(sequence)}", tuple(kind.value for kind in kinds)
    caption = "Events in a run, mean over runs."
    return Table(name, "Events", caption, columns, tuple(rows)) if kinds else None


def read_stage_times(cell: Cell, folder: Path, times: Times) -> None:
    """Append the times of a run's frames; of keyframe stages, those of keyframes only."""
    path = folder / cell.folder / FRAMES
    if cell.status is not CellStatus.DONE or not cell.folder or not path.is_file():
        return
    frames = read_frames(path)
    for stage, stage_ms in frames.stage_ms.items():
        chosen = np.isfinite(stage_ms)
        if stage in KEYFRAME_STAGES:
            chosen &= frames.keyframe_ids >= 0
        if chosen.any():
            times[stage] += stage_ms[chosen].tolist()


def map_pictures(comparison: Comparison, sequence: str, folder: Path) -> list[Picture]:
    """The maps of a sequence from the first run that has any (the paper's Figs. 7, 13)."""
    for method in comparison.methods:
        for cell in comparison.of(sequence, method.name):
            if cell.folder and cell.status is CellStatus.DONE:
                run = folder / cell.folder
                drawn = [_map_picture(run / n, cell, t) for n, t in MAP_PICTURES.items()]
                if found := [picture for picture in drawn if picture is not None]:
                    return found
    return []


def _times_entry(times_ms: list[float]) -> Entry:
    if not times_ms:
        return Entry(EMPTY)
    median, high = np.percentile(times_ms, (50, 95))
    return Entry(f"{median:.1f}", f"95 %: {high:.1f}")


def _map_picture(path: Path, cell: Cell, shows: str) -> Picture | None:
    """A picture file, reduced in size; None if it cannot be read."""
    if not path.is_file():
        return None
    try:
        return read_picture(path, f"{cell.sequence}, {cell.method}: {shows}", PICTURE_WIDTH_PX)
    except InputError as error:
        logger.warning("%s; skipped in the report", error)
        return None
