"""Jobs on a Ray cluster whose machines see the same files (`pip install 'bmask-slam[ray]'`)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from types import TracebackType
from typing import Any

from bmask_slam.comparison.jobs.job import Job, Outcome, run_job
from bmask_slam.comparison.jobs.pool import Done
from bmask_slam.semantics.segmenters.ray_connection import connect


class RayPool:
    """Jobs as Ray tasks of one CPU.

    ``address`` is a cluster's, "auto" for the one that this machine belongs to, or "local" for one
    that is started here and ended with this process.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str) -> None:
        self._ray: Any = connect(address, local_cpus=1)
        self._remote = self._ray.remote(num_cpus=1, max_retries=0)(_run)

    def __enter__(self) -> RayPool:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._ray.shutdown()

    @property
    def workers(self) -> int:
        """CPUs of the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def run(self, jobs: Sequence[Job]) -> Generator[Done, None, None]:
        """See `bmask_slam.comparison.jobs.pool.Pool.run`."""
        waiting = {self._remote.remote(job): job for job in jobs}
        try:
            while waiting:
                (done,), _ = self._ray.wait(list(waiting), num_returns=1)
                job = waiting.pop(done)
                yield job, self._ray.get(done)
        finally:
            for reference in waiting:
                self._ray.cancel(reference, force=True)


def _run(job: Job) -> Outcome:
    """In a worker of the cluster; the job's own process ends with the worker."""
    return run_job(job)
