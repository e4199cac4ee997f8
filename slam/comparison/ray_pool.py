"""Jobs on a Ray cluster whose machines see the same files (`pip install 'bmask-slam[ray]'`)."""

from __future__ import annotations

import logging
import socket
from collections.abc import Generator, Sequence
from types import TracebackType
from typing import Any

from graph.errors import InputError
from slam.comparison.job import Job, Outcome, run_job
from slam.comparison.pool import Done

LOCAL = "local"
TIMEOUT_S = 5.0


class RayPool:
    """Jobs as Ray tasks of one CPU.

    ``address`` is a cluster's, "auto" for the one that this machine belongs to, or "local" for one
    that is started here and ended with this process.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """

    def __init__(self, address: str) -> None:
        try:
            import ray  # noqa: PLC0415 - optional, and slow to load
        except ImportError as error:
            raise InputError("--ray: needs Ray: pip install 'bmask-slam[ray]'") from error
        self._ray: Any = ray
        _check_address(address)
        where = {"num_cpus": 1} if address == LOCAL else {"address": address}
        try:
            ray.init(
                **where, include_dashboard=False, log_to_driver=False, logging_level=logging.WARNING
            )
        except (ConnectionError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"--ray {address}: no cluster answers there ({reason})") from error
        self._remote = ray.remote(num_cpus=1, max_retries=0)(_run)

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
        """See `slam.comparison.pool.Pool.run`."""
        waiting = {self._remote.remote(job): job for job in jobs}
        try:
            while waiting:
                (done,), _ = self._ray.wait(list(waiting), num_returns=1)
                job = waiting.pop(done)
                yield job, self._ray.get(done)
        finally:
            for reference in waiting:
                self._ray.cancel(reference, force=True)


def _check_address(address: str) -> None:
    """Refuse HOST:PORT where nothing listens: Ray itself would try for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not (colon and port.isdigit()):
        return
    try:
        socket.create_connection((host, int(port)), TIMEOUT_S).close()
    except OSError as error:
        raise InputError(
            f"--ray {address}: nothing answers there ({error}); start it by ray start --head, or "
            "leave --ray away"
        ) from error


def _run(job: Job) -> Outcome:
    """In a worker of the cluster; the job's own process ends with the worker."""
    return run_job(job)
