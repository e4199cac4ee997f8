"""Rerun's web viewer as a process of its own, that listens where it is told to.

The servers that Rerun's Python functions start listen on all network interfaces; its program takes
an address.
"""

from __future__ import annotations

import logging
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType
from urllib.parse import quote

from bmask_slam.graph.errors import InputError
from bmask_slam.viewer.options import LOCAL

logger = logging.getLogger(__name__)

START_S, END_S = 20.0, 5.0
_START = (
    "import ctypes, os, sys; sys.platform == 'linux' and ctypes.CDLL(None).prctl(1, 15); "
    "os.execv(sys.argv[1], sys.argv[1:])"
)
"""What the child does: ask Linux for SIGTERM when its parent ends, and become Rerun."""


class WebViewer:
    """Serves one recording stream in a browser.

    Attributes:
        address: to connect a recording stream to.
        url: to open in a browser.
    """

    def __init__(self, cli: ModuleType, host: str, port: int) -> None:
        """Start it on ``port``, its data on a free port, both of ``host``.

        Raises:
            InputError: it does not start, as when the port is taken.
        """
        if host not in (LOCAL, "localhost"):
            logger.warning("%s: everyone who reaches this address sees the map and images", host)
        near = LOCAL if host == "0.0.0.0" else host  # nosec B104 # given by --host, with a warning
        data_port = _free_port(host, port)
        program = Path(str(cli.__file__)).with_name("rerun")
        places = ["--bind", host, "--port", str(data_port), "--web-viewer-port", str(port)]
        self._process = subprocess.Popen(  # nosec B603 # Rerun's own program, an address, ports
            [sys.executable, "-P", "-c", _START, str(program), "--serve-web", *places],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self.address = f"rerun+http://{near}:{data_port}/proxy"
        self.url = f"http://{near}:{port}?url={quote(self.address, safe='')}"
        self._wait_until_it_listens(near, (data_port, port))

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _wait_until_it_listens(self, host: str, ports: tuple[int, ...]) -> None:
        end_s = time.monotonic() + START_S
        while not all(_answers(host, port) for port in ports):
            if self._process.poll() is not None or time.monotonic() > end_s:
                self.close()
                raise InputError(
                    f"port {ports[-1]} of {host}: the web viewer does not start; give a free one "
                    "with --serve PORT, and an address of this machine with --host"
                )
            time.sleep(0.05)


def _answers(host: str, port: int) -> bool:
    try:
        with socket.create_connection((host, port), timeout=1.0):
            return True
    except OSError:
        return False


def _free_port(host: str, wanted: int) -> int:
    """A free port; ``wanted`` must be free too. Raises InputError."""
    try:
        with socket.create_server((host, wanted)), socket.create_server((host, 0)) as free:
            return int(free.getsockname()[1])
    except (OSError, OverflowError) as error:
        raise InputError(
            f"port {wanted} of {host}: {getattr(error, 'strerror', None) or error}; give another "
            "one with --serve PORT or --host"
        ) from error
