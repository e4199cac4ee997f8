"""Temporary folders do not stay when their process is killed."""

import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from bmask_slam.runtime.scratch import scratch_folder

HOLD = """
from bmask_slam.runtime.scratch import scratch_folder
with scratch_folder() as folder:
    (folder / "state").write_bytes(b"x")
    print(folder, flush=True)
    input()
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of temporary files."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def holder() -> tuple[subprocess.Popen[str], Path]:
    """A process that has a scratch folder."""
    pipe = subprocess.PIPE
    found = subprocess.Popen([sys.executable, "-c", HOLD], stdin=pipe, stdout=pipe, text=True)
    assert found.stdout is not None
    return found, Path(found.stdout.readline().strip())


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such locks")
def test_what_a_killed_process_left_is_removed(temporary: Path) -> None:
    (killed, left), (living, used) = holder(), holder()
    killed.kill()
    killed.wait()
    rescued = temporary / "bmask-slam-rescued"
    rescued.mkdir()
    assert (left / "state").is_file()
    with scratch_folder() as folder:
        assert not left.exists()
        assert (used / "state").is_file()
        assert sorted(temporary.iterdir()) == sorted([folder, used, rescued])
    living.communicate("\n")
    assert list(temporary.iterdir()) == [rescued]
