"""Modules that lie in the current folder, as in a downloaded recording, are never imported."""

from __future__ import annotations

import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, run_job

NAMES = (
    *("queue", "json", "csv", "socket", "pickle", "zipfile", "threading", "signal", "ctypes"),
    *("numpy", "cv2", "torch", "gtsam", "ray", "tqdm", "rerun", "usercustomize", "sitecustomize"),
)
"""Of the standard library, of what is installed, and what Python looks for when it starts."""


@pytest.fixture
def hostile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The current folder, first on this process's import path too; nothing in it may be run."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(
            f"from pathlib import Path; Path({str(tmp_path / 'ran')!r}).touch()"
        )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", str(tmp_path), *sys.path])
    yield tmp_path
    assert not (tmp_path / "ran").exists()


def test_live_and_its_processes(office: Path, hostile: Path) -> None:
    words = ["live", str(office), "--segmenter", "none", "--quiet", "--out", "run"]
    command = [sys.executable, "-P", "-m", "bmask_slam", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    assert (hostile / "run" / "trajectory.txt").is_file()


def test_jobs_of_compare(hostile: Path) -> None:
    log, product = hostile / "job" / "log.txt", hostile / "job" / "log.txt"
    job = Job("a", "a", ("info", "--help"), str(product), str(hostile / "job.json"), str(log))
    assert run_job(job).status is CellStatus.DONE, log.read_text()


def test_the_web_viewer(hostile: Path) -> None:
    rerun_cli = pytest.importorskip("rerun_cli")
    from bmask_slam.viewer.web_viewer import WebViewer, _free_port

    viewer = WebViewer(rerun_cli, "127.0.0.1", _free_port("127.0.0.1", 0))
    try:
        with urllib.request.urlopen(viewer.url.partition("?")[0], timeout=120) as page:
            assert page.status == 200
    finally:
        viewer.close()
