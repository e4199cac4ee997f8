"""Modules that lie in the current folder, as in a downloaded recording, are never imported."""

from __future__ import annotations

import ast
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from bmask_slam.comparison.experiment.result import CellStatus
from bmask_slam.comparison.jobs.job import Job, run_job
from bmask_slam.doctor.cameras import ask_libraries

ROOT = Path(__file__).parents[2]
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


def test_the_libraries_that_doctor_asks(hostile: Path) -> None:
    (asked,) = ask_libraries(["cv2"])
    assert not asked.error or "OpenNI" in asked.error  # it was asked, and answered


def test_every_process_of_this_python_is_started_without_the_current_folder() -> None:
    """``-P`` comes right after the interpreter, wherever one is started."""
    started, parts = 0, [ROOT / part for part in ("slam", "graph", "semantics", "mapping")]
    for file in (file for part in parts for file in part.rglob("*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, ast.List) and node.elts and is_interpreter(node.elts[0]):
                started += 1
                assert ast.unparse(node.elts[1]) == "'-P'", f"{file}:{node.lineno}"
    assert started >= 8


def is_interpreter(node: ast.expr) -> bool:
    return isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.executable"


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
