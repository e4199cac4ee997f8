"""``bmask-slam optimise`` for every graph and run of a folder, on this machine or by Ray."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

from bmask_slam.comparison.comparing import job_pool
from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.bar import JobBar
from bmask_slam.comparison.jobs.job import Job, Outcome, finished
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import plain_path, refuse_link
from bmask_slam.graph.files.reading import read_bytes, read_text
from bmask_slam.run_folder.folder import CHECKPOINT

SUFFIXES = (".g2o", ".graph")
JOBS, GRAPH = "jobs", "graph"
_SHOWN = (
    "initial cost",
    "final cost",
    "certificate",
    "outliers",
    "stage bundle adjustment",
    "time",
)


@dataclass(frozen=True)
class FolderOptions:
    """What is optimised and where.

    Attributes:
        folder: with files ``*.g2o`` and ``*.graph`` and run folders.
        out: folder for the results, of the same names, and ``jobs/`` with their logs.
        more: further arguments of each ``bmask-slam optimise``.
        workers: how many at a time; None: as many as there are cores.
        ray: address of a Ray cluster to use instead of this machine.
    """

    folder: Path
    out: Path
    more: tuple[str, ...] = ()
    workers: int | None = None
    ray: str | None = None
    quiet: bool = False

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InputError(f"--jobs {self.workers}: must be at least 1")


def optimise_folder(options: FolderOptions) -> list[tuple[Job, Outcome]]:
    """Optimise all; what was done with the same input and arguments is not done again.

    One that fails does not stop the others; its outcome has the reason.

    Raises:
        InputError: nothing to optimise in the folder, or ``out`` is the folder itself.
    """
    folder, out = options.folder.resolve(), options.out.resolve()
    if out == folder:
        raise InputError(f"{options.out}: is the input, which stays as it is; choose another --out")
    inputs = sorted(path for path in folder.iterdir() if _is_input(path))
    if not inputs:
        raise InputError(
            f"{options.folder}: no run folder, and none in it, nor *.g2o or *.graph; give another"
        )
    out.mkdir(parents=True, exist_ok=True)
    jobs = [_job(path, out, options.more) for path in inputs]
    outcomes = {job.name: outcome for job in jobs if (outcome := finished(job))}
    missing = [job for job in jobs if job.name not in outcomes]
    with (
        job_pool(options.workers, options.ray) as pool,
        JobBar(missing, pool.workers, options.quiet) as bar,
        closing(pool.run(missing)) as ended,
    ):
        for job, outcome in ended:
            outcomes[job.name] = outcome
            bar.update(job, outcome)
    return [(job, outcomes[job.name]) for job in jobs]


def format_folder(done: Sequence[tuple[Job, Outcome]]) -> str:
    """A line for each input: done or why not, and the costs that its log holds."""
    width = max(len(job.name) for job, _ in done)
    return "\n".join(f"{job.name:{width}}  {_line(job, outcome)}" for job, outcome in done)


def _line(job: Job, outcome: Outcome) -> str:
    if outcome.status is not CellStatus.DONE:
        return f"{outcome.status.value}: {outcome.error}"
    lines = read_text(Path(job.log), "optimise again").splitlines()
    shown = [" ".join(line.split()) for name in _SHOWN for line in lines if line.startswith(name)]
    return "; ".join([f"done in {outcome.wall_s:.1f} s", *shown])


def _is_input(path: Path) -> bool:
    return path.suffix in SUFFIXES if path.is_file() else is_run_folder(path)


def is_run_folder(path: Path) -> bool:
    """Whether a folder is one that ``bmask-slam run`` has written, or began to."""
    return any((path / name).exists() for name in ("metrics.json", GRAPH, CHECKPOINT))


def _job(path: Path, out: Path, more: tuple[str, ...]) -> Job:
    is_file = path.is_file()
    product, record = out / path.name, plain_path(out, f"{JOBS}/{path.name}/record.json")
    refuse_link(product)
    # A run that these jobs made before, from another input, is replaced; nobody else's is.
    again = ("--overwrite",) if not is_file and record.is_file() else ()
    arguments = ("optimise", str(path), "--out", str(product), *more, *again)
    read = path if is_file else path / GRAPH
    digest = sha256(read_bytes(read, "optimise another")).hexdigest() if read.is_file() else ""
    return Job(
        name=path.name,
        group="graphs" if is_file else "runs",
        arguments=arguments,
        product=str(product if is_file else product / "metrics.json"),
        record=str(record),
        log=str(record.with_name("log.txt")),
        depends={"input": digest, "arguments": " ".join(more)},
    )
