"""Fixtures of several tests of the live loop."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def small_disk(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Path]:
    """A file system of 300 kB, too small for a run folder's map, or of another size."""
    path = tmp_path / "disk"
    path.mkdir()
    size = getattr(request, "param", "300k")
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(path)]
    if shutil.which("mount") is None or subprocess.call(command, stderr=-3):
        pytest.skip("a small file system cannot be mounted: not root, or not Linux")
    yield path
    subprocess.run(["umount", str(path)], check=True)
