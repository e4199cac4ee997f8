"""The heap is on huge pages, in a process of its own for each question."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

GIVEN = Path("/sys/kernel/mm/transparent_hugepage/enabled")
pytestmark = pytest.mark.skipif(not GIVEN.exists(), reason="this kernel has no huge pages")
CODE = """
from bmask_slam.graph.smoother.huge_pages import use_huge_pages
held = []
for _ in range(100):
    use_huge_pages()
    held.append([bytes(600) for _ in range(3000)])  # as a keyframe may need
use_huge_pages()
print(open("/proc/self/smaps").read())
"""


def heap(**environment: str) -> list[tuple[int, int, bool]]:
    """Size and huge pages in kB of each part of a process's heap, and whether they were asked."""
    shown = subprocess.run(
        [sys.executable, "-c", CODE],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    parts = re.split(r"^(?=[0-9a-f]+-[0-9a-f]+ )", shown, flags=re.M)
    found = []
    for part in parts:
        if "[heap]" in part.partition("\n")[0]:
            size, huge = (
                int(re.search(rf"^{name}:\s+(\d+)", part, re.M)[1])
                for name in ("Size", "AnonHugePages")
            )
            found.append((size, huge, " hg" in re.search("^VmFlags:.*", part, re.M)[0]))
    return found


def test_all_of_the_heap_is_asked_for() -> None:
    parts = heap()
    assert sum(size for size, _, _ in parts) > 180_000
    assert all(asked for _, _, asked in parts)
    if "[never]" not in GIVEN.read_text():
        assert sum(huge for _, huge, _ in parts) > 100_000


def test_where_its_user_has_set_malloc_nothing_is_changed() -> None:
    parts = heap(GLIBC_TUNABLES="glibc.malloc.check=0")
    assert sum(size for size, _, _ in parts) > 180_000
    assert not any(asked for _, _, asked in parts)
