"""What a person sees while jobs run: how many are done, and how long the others will take."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from statistics import mean
from types import TracebackType

from tqdm import tqdm

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, Outcome


class JobBar:
    """A bar on stderr. The time left follows from jobs of the same group, else of the same kind."""

    def __init__(self, jobs: Iterable[Job], workers: int, quiet: bool) -> None:
        self._left = list(jobs)
        self._workers = workers
        self._took_s: dict[str, list[float]] = defaultdict(list)
        self._failed = 0
        self._bar = tqdm(
            total=len(self._left),
            disable=quiet or not self._left,
            unit="job",
            dynamic_ncols=True,
            mininterval=0,
            bar_format="{n_fmt}/{total_fmt} {bar} {elapsed}{postfix}",
            file=sys.stderr,
        )

    def __enter__(self) -> JobBar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._bar.close()

    def update(self, job: Job, outcome: Outcome) -> None:
        """A job ended."""
        self._left.remove(job)
        if outcome.status is CellStatus.DONE:
            for name in (job.group, _kind(job)):
                self._took_s[name].append(outcome.wall_s)
        self._failed += outcome.status is CellStatus.FAILED
        failed = f", {self._failed} failed" if self._failed else ""
        self._bar.set_postfix_str(f"{_minutes(self.left_s())} left{failed}, {job.name}", False)
        self._bar.update()

    def drop(self, job: Job) -> None:
        """A job will not be run."""
        self._left.remove(job)
        self._failed += 1
        self._bar.update()

    def left_s(self) -> float:
        """Expected seconds until all jobs are done; 0 while nothing is known."""
        known = [mean(took) for took in self._took_s.values()]
        fallback = mean(known) if known else 0.0
        expected = 0.0
        for job in self._left:
            took = self._took_s.get(job.group) or self._took_s.get(_kind(job))
            expected += mean(took) if took else fallback
        return expected / self._workers


def _kind(job: Job) -> str:
    return job.arguments[0]


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
