"""The disk becomes read-only during a run, as after an error of it: open files included.

A file system in a file is told of an error, upon which Linux makes it read-only at once; a remount
would be refused while files are open.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from faults import running
from feeding import track_frames
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.tracking.results import TrackingStatus

FRAMES = PlaneViews(sideways_path(0.02 * np.arange(12)))


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[tuple[Path, Callable[[], object]]]:
    """A file system of its own, and a function that makes it read-only."""
    image, path = tmp_path / "image", tmp_path / "disk"
    with image.open("wb") as file:
        file.truncate(32 << 20)
    path.mkdir()
    mount = ["mount", "-o", "loop,errors=remount-ro", str(image), str(path)]
    found = all(shutil.which(name) for name in ("mkfs.ext4", "mount"))
    if not found or subprocess.call(["mkfs.ext4", "-q", str(image)]):
        pytest.skip("no mkfs.ext4 here")
    if subprocess.call(mount, stderr=-3):
        pytest.skip("a file system cannot be mounted: not root, or not Linux")
    line = next(text for text in Path("/proc/mounts").read_text().splitlines() if str(path) in text)
    fault = Path("/sys/fs/ext4") / Path(line.split()[0]).name / "trigger_fs_error"
    try:
        if not os.access(fault, os.W_OK):
            pytest.skip("the file system cannot be told of an error")
        yield path, lambda: fault.write_text("1")
    finally:
        subprocess.run(["umount", str(path)], check=True)


def test_an_offline_run_ends_with_one_line_and_keeps_what_was_written(disk, tmp_path: Path) -> None:
    path, fail = disk
    sequence, out = make_sequence(tmp_path / "seq"), path / "run"
    make = partial(FakeSystem, on_frame=lambda k: k == 8 and fail())
    with pytest.raises(InputError, match="Read-only file system; make it writable again, what was"):
        run(RunOptions(sequence, out=out, quiet=True), make)
    assert len((out / "frames.csv").read_text().splitlines()) == 1 + 8


def test_a_live_run_tracks_on_and_saves_the_trajectory_elsewhere(disk) -> None:
    path, fail = disk
    with LiveSlam(CAMERA, None, LiveOptions(path / "run")) as slam:
        track_frames(slam, FRAMES[:5])
        fail()
        assert set(track_frames(slam, FRAMES[5:])) == {TrackingStatus.OK}
        assert slam.health().unwritten > 0
        pids = list(slam.processes().values())
        with pytest.raises(InputError, match=r"Read-only file.*whole trajectory is in") as caught:
            slam.close()
    elsewhere = Path(str(caught.value).rsplit(" ", 1)[1])
    assert len(read_tum(elsewhere)) == len(FRAMES)
    shutil.rmtree(elsewhere.parent)
    assert not running(pids)
