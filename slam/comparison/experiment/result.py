"""Results of a comparison, complete or not: plain values that are saved as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BeforeValidator

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.graph.files.json_file import check_json, read_json
from bmask_slam.graph.files.whole_file import whole_file

if TYPE_CHECKING:
    import pandas

RESULTS = "results.json"
FORMAT_VERSION = 1
MIN_COVERAGE = 0.95
"""An error of a trajectory that covers less of its sequence is shown, but never compared."""


class Kind(Enum):
    """RUN: run here. TRAJECTORY: another system's file, evaluated here. PUBLISHED: a quotation."""

    RUN = "run"
    TRAJECTORY = "trajectory"
    PUBLISHED = "published"


class CellStatus(Enum):
    """Whether a cell has figures; only DONE cells enter a mean."""

    DONE = "done"
    FAILED = "failed"
    PENDING = "pending"


Figure = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number that JSON has as null where it is not finite."""


@dataclass(frozen=True)
class Method:
    """A row of the tables: a configuration of this system, or another system.

    Attributes:
        name: as printed, unique.
        kind: where its figures come from.
        note: a configuration's differences, or the source of a published figure.
        with_scale: aligned by Sim(3).
    """

    name: str
    kind: Kind
    note: str = ""
    with_scale: bool = False


@dataclass(frozen=True)
class Cell:
    """A method on a sequence with a seed.

    Attributes:
        sequence, method: their names.
        seed: of a run; None where there is none.
        status: DONE, FAILED or PENDING.
        metrics: value by metric name (`reporting.metric_table`), those that exist.
        folder: the run folder, relative to the comparison's; "" without one.
        trajectory, reference: TUM files that were compared, relative to the comparison's folder or
            absolute; "" without.
        log: file with the run's output; "" without one.
        error: why it failed, one line.
        source: of a published figure.
    """

    sequence: str
    method: str
    seed: int | None
    status: CellStatus
    metrics: dict[str, Figure] = field(default_factory=dict)
    folder: str = ""
    trajectory: str = ""
    reference: str = ""
    log: str = ""
    error: str = ""
    source: str = ""

    @property
    def coverage(self) -> float:
        """The share of the frames that have a pose; 1 where their number is not known."""
        return self.metrics.get("tracked_share", 1.0)


@dataclass(frozen=True)
class Comparison:
    """All cells of an experiment and their provenance.

    Attributes:
        name, title, description: of the experiment.
        sequences: names in the order of the columns.
        methods: in the order of the rows.
        cells: one for each sequence, method and seed.
        provenance: commit, machine, versions, command, date, the resolved experiment; by name.
        drawn: rendered sequences, whose images depend on the seed; for the others the seed is the
            system's only.
    """

    name: str
    title: str
    description: str
    sequences: tuple[str, ...]
    methods: tuple[Method, ...]
    cells: tuple[Cell, ...]
    provenance: dict[str, Any] = field(default_factory=dict)
    drawn: tuple[str, ...] = ()

    def of(self, sequence: str, method: str) -> Iterator[Cell]:
        """The cells of a sequence and a method, one for each seed."""
        return (c for c in self.cells if c.sequence == sequence and c.method == method)

    def to_pandas(self) -> pandas.DataFrame:
        """A row a cell: sequence, method, kind, seed, status, error, and a column a metric.

        Raises:
            InputError: pandas is not installed.
        """
        frames: Any = import_extra("pandas", "a frame of the results", "pandas")
        kinds = {method.name: method.kind.value for method in self.methods}
        rows = [
            {
                "sequence": cell.sequence,
                "method": cell.method,
                "kind": kinds[cell.method],
                "seed": cell.seed,
                "status": cell.status.value,
                "error": cell.error,
                **cell.metrics,
            }
            for cell in self.cells
        ]
        return frames.DataFrame(rows)


def write_results(path: Path, comparison: Comparison) -> None:
    """Write a comparison as JSON, whole or not at all; NaN becomes null."""
    plain = {"format": FORMAT_VERSION} | asdict(comparison)
    text = json.dumps(_finite(plain), indent=1, default=lambda value: value.value)
    with whole_file(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")


def read_results(path: Path) -> Comparison:
    """Read what `write_results` wrote; ``path`` is the file or the comparison's folder.

    Raises:
        InputError: it is missing, not JSON, or of another format.
    """
    path = path / RESULTS if path.is_dir() else path
    cure = "make it by bmask-slam compare"
    plain = read_json(path, dict[str, Any], cure)
    if plain.pop("format", None) != FORMAT_VERSION:
        raise InputError(f"{path}: not a comparison of format {FORMAT_VERSION}; compare again")
    return check_json({"sequences": (), "drawn": ()} | plain, Comparison, str(path), cure)


def _finite(value: object) -> object:
    """The same with None for NaN and infinity, which JSON lacks."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
