"""Running an experiment: render, run, evaluate, and keep the results."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from bmask_slam.comparison.experiment.experiment import Configuration, Experiment
from bmask_slam.comparison.experiment.experiment_file import read_experiment
from bmask_slam.comparison.experiment.options import CompareOptions, select_part
from bmask_slam.comparison.experiment.provenance import provenance
from bmask_slam.comparison.experiment.result import (
    RESULTS,
    Cell,
    CellStatus,
    Comparison,
    Kind,
    Method,
    write_results,
)
from bmask_slam.comparison.jobs.bar import JobBar
from bmask_slam.comparison.jobs.cells import CellKey
from bmask_slam.comparison.jobs.errors import Rules, run_figures, trajectory_errors
from bmask_slam.comparison.jobs.external import other_methods, published_cells, trajectory_cells
from bmask_slam.comparison.jobs.job import Job, Outcome, finished
from bmask_slam.comparison.jobs.plan import Plan, make_plan
from bmask_slam.comparison.jobs.pool import LocalPool, Pool, RayPool
from bmask_slam.comparison.report import write_report
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_lock import take_lock
from bmask_slam.graph.files.whole_file import open_plain, writing

logger = logging.getLogger(__name__)

Cells = dict[CellKey, Cell]


def compare(
    experiment: str | Path | Experiment, out: str | Path, options: CompareOptions | None = None
) -> Comparison:
    """Run an experiment, from a file or a shipped one by name, in the folder ``out``.

    Cells that are done in ``out`` with the same code, configuration and images are not run again.
    ``out`` then holds ``results.json``, ``sequences/`` (rendered), ``cells/`` with a run folder and
    a log each, and the report. A cell that fails is FAILED and does not stop the others.

    Raises:
        InputError: an impossible experiment or option, or another comparison runs in ``out``.
    """
    options = options or CompareOptions()
    if not isinstance(experiment, Experiment):
        experiment = read_experiment(experiment)
    experiment = select_part(experiment, options)
    with _locked(Path(out).absolute()) as folder, job_pool(options.workers, options.ray) as pool:
        plan = make_plan(experiment, folder, options)
        origin = provenance(experiment, pool.workers)
        cells: Cells = {key: _pending(plan, key) for key in plan.cells()}
        others = tuple(_other_cells(plan))

        def save() -> Comparison:
            comparison = _comparison(plan, (*cells.values(), *others), origin)
            write_results(folder / RESULTS, comparison)
            return comparison

        save()
        _run_missing(plan, pool, cells, save, options.quiet)
        others = tuple(_other_cells(plan))  # again, since rendered sequences now have their truth
        comparison = save()
        write_report(comparison, folder)
        return comparison


def job_pool(workers: int | None, ray: str | None) -> LocalPool | RayPool:
    """So many workers of this machine, or the Ray cluster of an address."""
    return RayPool(ray) if ray else LocalPool(workers)


def _run_missing(
    plan: Plan, pool: Pool, cells: Cells, save: Callable[[], object], quiet: bool
) -> None:
    """Render missing sequences, then run missing cells; each cell is saved when it ends."""
    before = {key: finished(job) for key, job in plan.jobs.items()}
    cells |= {key: _run_cell(plan, key, outcome) for key, outcome in before.items() if outcome}
    save()
    remaining = {plan.jobs[key].record: key for key, outcome in before.items() if outcome is None}
    to_render = [s.render for s in plan.sequences if s.render and not finished(s.render)]
    with JobBar(
        [*to_render, *(plan.jobs[key] for key in remaining.values())], pool.workers, quiet
    ) as bar:
        failed = _render(pool, to_render, bar)
        for record, key in list(remaining.items()):
            render = plan.sequence(key.sequence, key.seed).render
            if render is not None and render.record in failed:
                cells[key] = _not_rendered(plan, cells[key], render, failed[render.record])
                bar.drop(plan.jobs[remaining.pop(record)])
        with closing(pool.run([plan.jobs[key] for key in remaining.values()])) as ended:
            for job, outcome in ended:
                key = remaining[job.record]
                cells[key] = _run_cell(plan, key, outcome)
                bar.update(job, outcome)
                save()


def _render(pool: Pool, jobs: list[Job], bar: JobBar) -> dict[str, Outcome]:
    """Render sequences; returns the outcomes of those that failed, by record."""
    failed = {}
    with closing(pool.run(jobs)) as ended:
        for job, outcome in ended:
            bar.update(job, outcome)
            if outcome.status is not CellStatus.DONE:
                failed[job.record] = outcome
    return failed


# --- Cells ---------------------------------------------------------------------------------------


def _cell(key: CellKey, status: CellStatus, log: str = "", error: str = "") -> Cell:
    return Cell(key.sequence, key.configuration, key.seed, status, log=log, error=error)


def _pending(plan: Plan, key: CellKey) -> Cell:
    """A cell before it is run, with the reason if it cannot be run."""
    return _cell(key, CellStatus.PENDING, error=plan.sequence(key.sequence, key.seed).problem)


def _not_rendered(plan: Plan, cell: Cell, render: Job, outcome: Outcome) -> Cell:
    """A cell whose sequence could not be rendered."""
    error, log = f"rendering failed: {outcome.error}", _relative(plan, render.log)
    return replace(cell, status=CellStatus.FAILED, error=error, log=log)


def _run_cell(plan: Plan, key: CellKey, outcome: Outcome) -> Cell:
    """The cell of a run that has ended."""
    job = plan.jobs[key]
    cell = _cell(key, outcome.status, log=_relative(plan, job.log))
    if outcome.status is not CellStatus.DONE:
        return replace(cell, error=outcome.error)
    run = Path(job.run)
    metrics = run_figures(run) | outcome.figures
    cell = replace(cell, folder=_relative(plan, job.run))
    trajectory, reference = run / "trajectory.txt", plan.sequence(key.sequence, key.seed).reference
    if reference is None:
        return replace(cell, metrics=metrics, trajectory=_relative(plan, str(trajectory)))
    experiment = plan.experiment
    rules = Rules(experiment.max_time_difference_s, experiment.with_scale)
    cell = replace(
        cell, trajectory=_relative(plan, str(trajectory)), reference=_relative(plan, str(reference))
    )
    try:
        errors = trajectory_errors(trajectory, reference, rules)
    except InputError as error:
        return replace(cell, status=CellStatus.FAILED, error=str(error))
    return replace(cell, metrics=metrics | errors)


def _other_cells(plan: Plan) -> Iterator[Cell]:
    yield from trajectory_cells(plan.experiment, plan.sequence, plan.files)
    yield from published_cells(plan.experiment)


def _comparison(plan: Plan, cells: Iterable[Cell], origin: dict[str, Any]) -> Comparison:
    experiment = plan.experiment
    own = (
        Method(name, Kind.RUN, _note(configuration), experiment.with_scale)
        for name, configuration in experiment.configurations.items()
    )
    return Comparison(
        experiment.name,
        experiment.title,
        experiment.description,
        tuple(s.name for s in experiment.sequences),
        (*own, *other_methods(experiment)),
        tuple(cells),
        origin,
        tuple(s.name for s in experiment.sequences if s.render is not None),
    )


def _note(configuration: Configuration) -> str:
    """A configuration's purpose, and its options."""
    words = " ".join(configuration.arguments())
    return "; ".join(filter(None, (configuration.note, words)))


def _relative(plan: Plan, path: str) -> str:
    """A path relative to the comparison's folder; absolute outside it."""
    inside = Path(path).is_relative_to(plan.folder)
    return str(Path(path).relative_to(plan.folder)) if inside else str(Path(path).absolute())


@contextmanager
def _locked(folder: Path) -> Iterator[Path]:
    """Make the folder if needed and lock it for this process. Raises InputError."""
    with writing(folder, "choose another --out"):
        folder.mkdir(parents=True, exist_ok=True)
        file = open_plain(folder / ".lock", "w")
    with file:
        if not take_lock(file):
            raise InputError(f"{folder}: another bmask-slam compare runs there; wait for it")
        file.write(str(os.getpid()))
        yield folder
