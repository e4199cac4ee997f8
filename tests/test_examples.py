"""The examples run as they stand."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.cli import main

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("example") / "office"
    assert main(["render", "office", "--frames", "8", "--out", str(path)]) == 0
    return path


def test_live(recording, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "live.py"), str(recording)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 9
    assert all(" OK " in line for line in lines[:8])
    assert (tmp_path / "runs" / "live" / "trajectory.txt").is_file()
