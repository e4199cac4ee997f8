"""The sections of a comparison's report, in the order in which they are read."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

from bmask_slam.comparison.experiment.result import MIN_COVERAGE, Cell, CellStatus, Comparison
from bmask_slam.comparison.report.curves import network_pictures
from bmask_slam.comparison.report.figures import error_pictures
from bmask_slam.comparison.report.run_files import event_table, map_pictures, stage_table
from bmask_slam.comparison.report.table import (
    ATE,
    cell_name,
    cell_tables,
    metric_table,
    metric_tables,
)
from bmask_slam.comparison.report.verdict_tables import (
    RULE,
    ablation_table,
    verdict_sentences,
    verdict_tables,
)
from bmask_slam.comparison.statistics import too_few, verdicts
from bmask_slam.graph.files.file_names import is_inside
from bmask_slam.graph.files.reading import read_text
from bmask_slam.graph.files.yaml_file import format_yaml
from bmask_slam.reporting.parts import Listing, Section, Table

LOG_LINES = 15
LINE_CHARACTERS = 400
EMPTY: tuple[Any, ...] = (None, "", [], {})


def make_sections(comparison: Comparison, folder: Path) -> list[Section]:
    """All sections that are not empty; ``folder`` holds the files of the cells."""
    sections = [
        _absolute_errors(comparison),
        _differences(comparison),
        _failures(comparison, folder),
        *_error_figures(comparison, folder),
        _other_metrics(comparison),
        _stages(comparison, folder),
        *_maps(comparison, folder),
        Section("Networks", pictures=tuple(network_pictures(comparison, folder))),
        Section("Every cell", tables=tuple(cell_tables(comparison)), printed=False),
        _provenance(comparison),
    ]
    return [section for section in sections if not section.empty]


def summary(comparison: Comparison) -> list[str]:
    """A summary of the comparison in sentences."""
    states = Counter(cell.status for cell in comparison.cells)
    counts = f"{_count(comparison.sequences, 'sequence')}, {_count(comparison.methods, 'method')}, "
    counts += f"{_count(comparison.cells, 'cell')}"
    failed, pending = states[CellStatus.FAILED], states[CellStatus.PENDING]
    if not failed and not pending:
        return [f"{counts}, all done.", *verdict_sentences(comparison)]
    reasons = dict.fromkeys(
        f"{cell.sequence}: {cell.error}"
        for cell in comparison.cells
        if cell.status is CellStatus.PENDING and cell.error
    )
    done = states[CellStatus.DONE]
    return [
        f"{counts}: {done} done, {failed} failed, {pending} pending.",
        *verdict_sentences(comparison),
        *reasons,
    ]


def log_tail(cell: Cell, folder: Path) -> str:
    """The last lines of a cell's log, or a sentence if there are none."""
    path = folder / cell.log
    if not is_inside(cell.log) or not path.is_file():
        return "(no log)"
    lines = read_text(path, "compare again").splitlines()[-LOG_LINES:]
    return "\n".join(line[:LINE_CHARACTERS] for line in lines) or "(the log is empty)"


def _absolute_errors(comparison: Comparison) -> Section:
    table = metric_table(comparison, ATE)
    text = (
        "Best figures measured here are bold; published figures are quoted from their sources and "
        "were not measured here. Alignment is SE(3) unless a row is marked Sim(3). A sequence with "
        "a failed run is marked, and is not compared for the best; nor is one of a trajectory that "
        f"covers less than {100 * MIN_COVERAGE:.0f} % of the sequence, which is marked too.",
    )
    return Section("Absolute trajectory error", text, (table,)) if table else Section("")


def _differences(comparison: Comparison) -> Section:
    few = too_few(verdicts(comparison))
    tables = [] if few else verdict_tables(comparison)
    ablation = ablation_table(comparison)
    text = (RULE,) if tables else ()  # that they are too few is in the summary
    return Section("Differences", text, (*([ablation] if ablation else []), *tables))


def _failures(comparison: Comparison, folder: Path) -> Section:
    failed = [cell for cell in comparison.cells if cell.status is CellStatus.FAILED]
    listings = tuple(
        Listing(
            f"{cell_name(cell)}, on {cell.sequence}: {cell.error or 'no reason given'}",
            log_tail(cell, folder),
        )
        for cell in failed
    )
    return Section("Failed runs", listings=listings)


def _error_figures(comparison: Comparison, folder: Path) -> list[Section]:
    return [
        Section(
            f"Errors on {name}",
            tables=tuple(filter(None, [event_table(comparison, name, folder)])),
            pictures=tuple(error_pictures(comparison, name, folder)),
        )
        for name in comparison.sequences
    ]


def _other_metrics(comparison: Comparison) -> Section:
    tables = [table for table in metric_tables(comparison) if table.name != ATE.name]
    shown = tuple(_without_notes(table) for table in tables)
    return Section("Other metrics", tables=shown, printed=False)


def _without_notes(table: Table) -> Table:
    """A table without the notes of its rows, which the main table has."""
    return replace(table, rows=tuple(replace(row, note="") for row in table.rows))


def _stages(comparison: Comparison, folder: Path) -> Section:
    table = stage_table(comparison, folder)
    return Section("Time", tables=(table,) if table else (), printed=False)


def _maps(comparison: Comparison, folder: Path) -> list[Section]:
    return [
        Section(
            f"Map of {name}", pictures=tuple(map_pictures(comparison, name, folder)), printed=False
        )
        for name in comparison.sequences
    ]


def _provenance(comparison: Comparison) -> Section:
    """Short values in one listing, and a listing for each long one."""
    values = {name: _without_empty(value) for name, value in comparison.provenance.items()}
    long = {name: value for name, value in values.items() if isinstance(value, (dict, list))}
    short = {name: value for name, value in values.items() if name not in long and value != ""}
    listings = [Listing("Run", _as_text(short))] if short else []
    listings += [
        Listing(name.capitalize(), _as_text(value)) for name, value in long.items() if value
    ]
    return Section("How it was made", listings=tuple(listings), printed=False)


def _without_empty(value: Any) -> Any:
    """The same without None, empty texts and empty collections."""
    if isinstance(value, dict):
        kept = {key: _without_empty(item) for key, item in value.items()}
        return {key: item for key, item in kept.items() if item not in EMPTY}
    if isinstance(value, (list, tuple)):
        return [_without_empty(item) for item in value]
    return value


def _as_text(value: Any) -> str:
    return format_yaml(value).strip()


def _count(items: tuple[object, ...], name: str) -> str:
    return f"{len(items)} {name}{'' if len(items) == 1 else 's'}"
