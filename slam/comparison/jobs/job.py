"""One job: a command of this program in a process of its own, and the record of how it ended."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import read_json
from bmask_slam.graph.files.reading import read_text
from bmask_slam.graph.files.whole_file import open_plain, remove, whole_file

THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
PROCESS = "bmask_slam.job_process"
"""Module that a job's process runs, given by name since this package must not import it."""
LAST_LINES = 30
LINE_LIMIT = 300


@dataclass(frozen=True)
class Job:
    """What to run. Files are absolute, so that a job can be sent to another process.

    Attributes:
        name: shown in the progress bar.
        group: jobs of one group take about as long as each other.
        arguments: of ``bmask-slam``.
        product: file that exists if it has succeeded.
        record: file with its outcome, written last.
        log: file with what the command printed.
        depends: hashes of what its result depends on, by name.
        sequence: folder whose truth is compared with the finished run ``run``; "" for none.
        run: the run folder, if it makes one.
        clear: folder that is removed first, "" for none.
    """

    name: str
    group: str
    arguments: tuple[str, ...]
    product: str
    record: str
    log: str
    depends: dict[str, str] = field(default_factory=dict)
    sequence: str = ""
    run: str = ""
    clear: str = ""


@dataclass(frozen=True)
class Outcome:
    """How a job ended.

    Attributes:
        status: DONE, FAILED, or PENDING where it was stopped before its end.
        error: one line.
        wall_s: how long it took.
        figures: what was measured against the sequence's truth, by metric.
        depends: of the job.
    """

    status: CellStatus
    error: str = ""
    wall_s: float = 0.0
    figures: dict[str, float] = field(default_factory=dict)
    depends: dict[str, str] = field(default_factory=dict)


Start = Callable[["subprocess.Popen[bytes]"], None]


def finished(job: Job) -> Outcome | None:
    """The outcome of an earlier run of the same job, if it succeeded and nothing has changed."""
    outcome = read_record(Path(job.record))
    if outcome is None or outcome.status is not CellStatus.DONE or outcome.depends != job.depends:
        return None
    return outcome if Path(job.product).exists() else None


def run_job(job: Job, threads: int = 1, started: Start = lambda process: None) -> Outcome:
    """Run a job to its end and record it; ``started`` is given the process.

    The process ends when this one has ended for whatever reason.
    """
    record, log = Path(job.record), Path(job.log)
    record.parent.mkdir(parents=True, exist_ok=True)
    log.parent.mkdir(parents=True, exist_ok=True)
    record.unlink(missing_ok=True)
    if job.clear:
        remove(Path(job.clear))
    begin_s = time.monotonic()
    with open_plain(log, "wb") as output:
        process = subprocess.Popen(  # nosec B603 # this program with arguments of its own
            [sys.executable, "-P", "-m", PROCESS, json.dumps(asdict(job))],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment(threads),
            start_new_session=True,
        )
        with process:
            started(process)
            code = process.wait()
    outcome = _outcome(job, code, time.monotonic() - begin_s)
    write_record(record, outcome)
    return outcome


def environment(threads: int) -> dict[str, str]:
    """This process's environment, with the threads of the numerical libraries limited."""
    return {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(threads))}


def figures_file(job: Job) -> Path:
    """The file in which the process writes its figures."""
    return Path(job.record).with_name("figures.json")


def read_record(path: Path) -> Outcome | None:
    """The outcome in a file; None where there is none that can be read."""
    try:
        return read_json(path, Outcome, "run it again")
    except InputError:
        return None


def write_record(path: Path, outcome: Outcome) -> None:
    """Write an outcome, whole or not at all."""
    plain = asdict(outcome) | {"status": outcome.status.value}
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(plain, indent=1) + "\n", encoding="utf-8")


def _outcome(job: Job, code: int, wall_s: float) -> Outcome:
    if code == 0 and Path(job.product).exists():
        file = figures_file(job)
        figures = read_json(file, dict[str, float], "compare again") if file.is_file() else {}
        return Outcome(CellStatus.DONE, "", wall_s, figures, job.depends)
    error = _last_error(Path(job.log)) or f"ended with status {code} without a message"
    if code < 0:
        error = f"killed by signal {-code}"
    return Outcome(CellStatus.FAILED, error, wall_s, {}, job.depends)


def _last_error(log: Path) -> str:
    """The last error message in a log, else its last line."""
    text = read_text(log, "compare again").replace("\r", "\n")
    lines = [line.strip() for line in text.splitlines() if line.strip()][-LAST_LINES:]
    errors = [line.removeprefix("error: ") for line in lines if line.startswith("error: ")]
    return (errors or lines or [""])[-1][:LINE_LIMIT]
