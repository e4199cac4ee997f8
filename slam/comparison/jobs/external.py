"""Cells of other systems: from their trajectory files, and from published figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from bmask_slam.comparison.experiment.experiment import Experiment
from bmask_slam.comparison.experiment.result import Cell, CellStatus, Kind, Method
from bmask_slam.comparison.jobs.cells import SequenceData
from bmask_slam.comparison.jobs.errors import Rules, trajectory_errors
from bmask_slam.graph.errors import InputError
from bmask_slam.sequences.lists import read_pairs
from bmask_slam.sequences.sequence import SequenceConfig


def trajectory_cells(
    experiment: Experiment,
    find_data: Callable[[str, int | None], SequenceData],
    files: Mapping[tuple[str, str], Path | None],
) -> Iterator[Cell]:
    """A cell for each file; one that cannot be evaluated is FAILED, a missing one PENDING."""
    for (method, key), file in files.items():
        name, _, seed = key.partition("@")
        data = find_data(name, int(seed) if seed.isdigit() else None)
        rules = Rules(experiment.max_time_difference_s, experiment.aligned_with_scale(method))
        cell = Cell(name, method, data.seed, CellStatus.PENDING)
        if file is None:
            name_in_file = experiment.systems[method].trajectories[key]
            cure = f"give it by --trajectory '{method}:{key}=FILE', or its folder by --data"
            yield replace(cell, error=f"{name_in_file}: not found; {cure}")
        else:
            yield _evaluated_cell(cell, file, data, rules)


def _evaluated_cell(cell: Cell, file: Path, data: SequenceData, rules: Rules) -> Cell:
    cell = replace(cell, status=CellStatus.FAILED, trajectory=str(file.absolute()))
    if data.reference is None or not data.reference.is_file():
        return replace(
            cell,
            error=f"{cell.sequence}: no ground truth; give it by --reference {cell.sequence}=FILE",
        )
    cell = replace(cell, reference=str(data.reference.absolute()))
    try:
        metrics = trajectory_errors(file, data.reference, rules, _frame_count(data.folder))
    except InputError as error:
        return replace(cell, error=str(error))
    return replace(cell, status=CellStatus.DONE, metrics=metrics)


def _frame_count(folder: Path | None) -> int | None:
    """Number of frames of a sequence; None without its images."""
    if folder is None:
        return None
    limit_s = SequenceConfig().max_time_difference_s
    return len(read_pairs(folder, limit_s, 0.0).timestamps_s)


def published_cells(experiment: Experiment) -> Iterator[Cell]:
    """A cell for each sequence and source that has figures."""
    for quotation in experiment.published:
        by_sequence: dict[str, dict[str, float]] = {}
        for metric, values in quotation.figures.items():
            for sequence, value in values.items():
                by_sequence.setdefault(sequence, {})[metric] = value
        for sequence, metrics in by_sequence.items():
            yield Cell(
                sequence, quotation.method, None, CellStatus.DONE, metrics, source=quotation.source
            )


def other_methods(experiment: Experiment) -> Iterator[Method]:
    """The rows after this system's own."""
    for name, system in experiment.systems.items():
        yield Method(name, Kind.TRAJECTORY, system.note, experiment.aligned_with_scale(name))
    for name in dict.fromkeys(q.method for q in experiment.published):
        with_scale = any(q.with_scale for q in experiment.published if q.method == name)
        yield Method(name, Kind.PUBLISHED, with_scale=with_scale)
