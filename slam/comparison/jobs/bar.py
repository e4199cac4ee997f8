"""A progress bar for jobs: how many are done, and how long the others will take."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from statistics import mean

from tqdm import tqdm

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, Outcome


class JobBar:
    """A bar on stderr with an estimate of the remaining time, by jobs of the same kind."""

    def __init__(self, jobs: Iterable[Job], workers: int, quiet: bool) -> None:
        self._remaining = list(jobs)
        self._workers = workers
        self._wall_s: dict[str, list[float]] = defaultdict(list)
        self._failed = 0
        self._bar = tqdm(
            total=len(self._remaining),
            disable=quiet or not self._remaining,
            unit="job",
            dynamic_ncols=True,
            mininterval=0,
            bar_format="{n_fmt}/{total_fmt} {bar} {elapsed}{postfix}",
            file=sys.stderr,
        )

    def __enter__(self) -> JobBar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self, job: Job, outcome: Outcome) -> None:
        """Count a job that ended."""
        self._remaining.remove(job)
        if outcome.status is CellStatus.DONE:
            for name in (job.group, _kind(job)):
                self._wall_s[name].append(outcome.wall_s)
        self._failed += outcome.status is CellStatus.FAILED
        failed = f", {self._failed} failed" if self._failed else ""
        self._bar.set_postfix_str(f"{_minutes(self.remaining_s())} left{failed}, {job.name}", False)
        self._bar.update()

    def drop(self, job: Job) -> None:
        """Count a job that will not be run as failed."""
        self._remaining.remove(job)
        self._failed += 1
        self._bar.update()

    def remaining_s(self) -> float:
        """Estimated seconds until all jobs are done; 0 before the first one is done."""
        means = [mean(times) for times in self._wall_s.values()]
        fallback = mean(means) if means else 0.0
        expected = 0.0
        for job in self._remaining:
            times = self._wall_s.get(job.group) or self._wall_s.get(_kind(job))
            expected += mean(times) if times else fallback
        return expected / self._workers


def _kind(job: Job) -> str:
    return job.arguments[0]


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
