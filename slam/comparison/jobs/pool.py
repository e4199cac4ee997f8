"""Where jobs run: in parallel on this machine, or on a Ray cluster."""

from __future__ import annotations

import subprocess
import threading
from collections.abc import Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import suppress
from typing import Any, Protocol

from bmask_slam.comparison.jobs.job import Job, Outcome, run_job
from bmask_slam.runtime.machine import available_cores
from bmask_slam.semantics.segmenters.ray_connection import connect

JobOutcome = tuple[Job, Outcome]


class Pool(Protocol):
    """Runs jobs; ``workers`` of them at a time."""

    @property
    def workers(self) -> int: ...

    def run(self, jobs: Sequence[Job]) -> Generator[JobOutcome, None, None]:
        """Yield each job with its outcome as it ends; closing the generator kills the others."""
        ...


class LocalPool:
    """Processes on this machine.

    ``workers`` None: as many as there are cores. Each gets its share of the cores as threads.
    """

    def __init__(self, workers: int | None = None) -> None:
        self._workers = workers or available_cores()
        self._threads = max(1, available_cores() // self._workers)
        self._running: set[subprocess.Popen[bytes]] = set()
        self._lock = threading.Lock()
        self._stopping = False

    def __enter__(self) -> LocalPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    @property
    def workers(self) -> int:
        return self._workers

    def run(self, jobs: Sequence[Job]) -> Generator[JobOutcome, None, None]:
        """See `Pool.run`."""
        self._stopping = False
        with ThreadPoolExecutor(self._workers) as executor:
            futures: dict[Future[Outcome], Job] = {
                executor.submit(run_job, job, self._threads, self._started): job for job in jobs
            }
            try:
                for future in as_completed(futures):
                    yield futures[future], future.result()
            finally:
                executor.shutdown(wait=False, cancel_futures=True)
                self._stop()

    def _started(self, process: subprocess.Popen[bytes]) -> None:
        with self._lock:
            self._running = {p for p in self._running if p.poll() is None} | {process}
            stopping = self._stopping
        if stopping:
            process.kill()

    def _stop(self) -> None:
        """Kill the jobs that still run."""
        with self._lock:
            self._stopping = True
            for process in self._running:
                with suppress(ProcessLookupError):
                    process.kill()
            self._running = set()


class RayPool:
    """Ray tasks of one CPU each (`pip install 'bmask-slam[ray]'`); all machines see the same files.

    ``address`` is a cluster's, "auto" for the one that this machine belongs to, or "local" for one
    that is started here and stopped with this process.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str) -> None:
        self._ray: Any = connect(address, local_cpus=1)
        self._remote = self._ray.remote(num_cpus=1, max_retries=0)(run_job)

    def __enter__(self) -> RayPool:
        return self

    def __exit__(self, *_: object) -> None:
        self._ray.shutdown()

    @property
    def workers(self) -> int:
        """CPUs of the cluster."""
        return max(1, int(self._ray.cluster_resources().get("CPU", 1)))

    def run(self, jobs: Sequence[Job]) -> Generator[JobOutcome, None, None]:
        """See `Pool.run`."""
        waiting = {self._remote.remote(job): job for job in jobs}
        try:
            while waiting:
                (done,), _ = self._ray.wait(list(waiting), num_returns=1)
                job = waiting.pop(done)
                yield job, self._ray.get(done)
        finally:
            for reference in waiting:
                self._ray.cancel(reference, force=True)
