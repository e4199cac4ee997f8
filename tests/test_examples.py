"""The examples run unchanged."""

from __future__ import annotations

import subprocess
import sys

from repository import ROOT


def test_live(office, tmp_path) -> None:
    done = subprocess.run(
        [sys.executable, str(ROOT / "examples" / "live.py"), str(office)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 16
    assert not any("LOST" in line for line in lines[:15])
    assert (tmp_path / "runs" / "live" / "trajectory.txt").is_file()
