"""The server for the browser: where it listens, and that it ends."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.live.play import play
from bmask_slam.viewer import web_viewer
from bmask_slam.viewer.options import ViewOptions
from bmask_slam.viewer.rerun_transport import RerunTransport
from bmask_slam.viewer.web_viewer import WebViewer

rerun_cli = pytest.importorskip("rerun_cli")
pytestmark = pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs Linux's /proc")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def listening(port: int) -> list[str]:
    """The addresses, in hexadecimal, on which somebody listens on a port."""
    rows = [
        line.split()
        for name in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    ends = [row[1].split(":") for row in rows if row[3] == "0A"]
    return [address for address, number in ends if int(number, 16) == port]


def ports_of(viewer: WebViewer) -> tuple[int, int]:
    return int(viewer.address.split(":")[2].split("/")[0]), int(viewer.url.split(":")[2][:5])


def test_it_listens_on_this_machine_only_and_ends() -> None:
    viewer = WebViewer(rerun_cli, "127.0.0.1", free_port())
    ports = ports_of(viewer)
    assert [listening(port) for port in ports] == [["0100007F"]] * 2
    viewer.close()
    assert [listening(port) for port in ports] == [[]] * 2


def test_what_is_shown_ends_though_the_server_takes_nothing(monkeypatch) -> None:
    """As on a busy machine: the stream would wait for it, and SIGTERM does not reach it."""
    monkeypatch.setattr(web_viewer, "END_S", 0.5)
    transport = RerunTransport("run", ViewOptions(serve=free_port()))
    viewer = transport._viewer
    assert viewer is not None
    process = viewer._process
    process.send_signal(signal.SIGSTOP)
    points = np.zeros((100_000, 3))
    for _ in range(50):  # more than the system's buffers hold
        transport._log("world/points", transport._rr.Points3D(points))
    transport.close()
    assert process.returncode == -signal.SIGKILL


def test_another_address_is_warned_about(caplog: pytest.LogCaptureFixture) -> None:
    viewer = WebViewer(rerun_cli, "0.0.0.0", free_port())
    assert listening(ports_of(viewer)[1]) == ["00000000"]
    assert "0.0.0.0: everyone who reaches" in caplog.text
    viewer.close()


def test_a_taken_port_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} of 127"):
            WebViewer(rerun_cli, "127.0.0.1", port)


def test_live_prints_an_address_that_answers_while_it_runs(
    office: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    """As ``view --serve`` does, whose address a browser opens in test_viewer_in_browser."""
    port, answers = free_port(), []

    def open_first(*arguments: Any) -> Any:
        printed = capsys.readouterr().err
        found = re.search(r"^in a browser: (http://127\.0\.0\.1:(\d+)\?url=\S+)$", printed, re.M)
        assert found, printed
        with urlopen(found[1], timeout=60) as page:
            answers.append((int(found[2]), b"Rerun" in page.read()))
        return play(*arguments)

    monkeypatch.setattr("bmask_slam.live.play.play", open_first)
    arguments = ["--segmenter", "none", "--calibrate", "off", "--max-frames", "2", "--quiet"]
    given = ["live", str(office), "--serve", str(port), "--out", str(tmp_path / "run")]
    assert main([*given, *arguments]) == 0
    assert answers == [(port, True)]
    assert not listening(port)


def test_it_ends_with_a_killed_parent() -> None:
    code = (
        "import sys, time, rerun_cli; from bmask_slam.viewer.web_viewer import WebViewer; "
        f"WebViewer(rerun_cli, '127.0.0.1', {(port := free_port())}); print('up', flush=True); "
        "time.sleep(60)"
    )
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "up\n"
        assert listening(port)
        os.kill(parent.pid, signal.SIGKILL)
    end_s = time.monotonic() + 60
    while listening(port) and time.monotonic() < end_s:
        time.sleep(0.1)
    assert not listening(port)
