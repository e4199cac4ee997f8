"""The peak of memory counts the processes that this one has."""

from __future__ import annotations

import subprocess
import sys

import pytest

from bmask_slam.runtime.memory import peak_rss_mb

HOLDS = "import sys; held = bytearray(b'1') * {size}; print('ready', flush=True); sys.stdin.read()"
SIZE = 120_000_000


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere this process's own is told alone")
def test_the_peak_counts_children_and_their_children() -> None:
    """Of a child that has children, they are counted: they have what it had when it was forked."""
    before = peak_rss_mb()
    code = HOLDS.format(size=SIZE)
    grandchild = f"import subprocess; subprocess.run([{sys.executable!r}, '-c', {code!r}])"
    for command in (code, grandchild):
        process = subprocess.Popen(
            [sys.executable, "-c", command], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert process.stdout and process.stdout.readline() == b"ready\n"
        assert before + 0.9e-6 * SIZE < peak_rss_mb() < before + 1.5e-6 * SIZE
        process.communicate()
    assert peak_rss_mb() < before + 0.5e-6 * SIZE
