"""Connection to a Ray cluster (``pip install 'bmask-slam[ray]'``)."""

from __future__ import annotations

import logging
import os
import socket
from typing import Any

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra

LOCAL = "local"
TIMEOUT_S = 5.0


def connect(address: str, local_cpus: int | None = None) -> Any:
    """The ``ray`` module, connected to a cluster.

    ``address`` is a cluster's, "auto" for the cluster of this machine, or "local" to start one
    here with ``local_cpus`` CPUs, which ends with this process.

    Raises:
        InputError: Ray is not installed, or there is no cluster at the address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    ray: Any = import_extra("ray", "--ray", "ray")
    if ray.is_initialized():
        return ray
    _check_address(address)
    here = address == LOCAL
    try:
        ray.init(
            address,
            job_config=_isolated(ray),
            num_cpus=local_cpus if here else None,
            include_dashboard=False if here else None,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (ConnectionError, RuntimeError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"--ray {address}: no cluster answers there ({reason})") from error
    return ray


def _isolated(ray: Any) -> Any:
    """A job whose workers do not import from this process's current folder, as Ray has it.

    That folder may hold foreign files, such as a downloaded recording with a ``json.py``.
    """

    class Isolated(ray.job_config.JobConfig):
        """Ray adds the current folder to this list when it connects."""

        @property
        def _py_driver_sys_path(self) -> list[str]:
            return []

        @_py_driver_sys_path.setter
        def _py_driver_sys_path(self, folders: list[str]) -> None:
            pass

    return Isolated()


def _check_address(address: str) -> None:
    """Refuse HOST:PORT without a listener: Ray itself would try for minutes."""
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
