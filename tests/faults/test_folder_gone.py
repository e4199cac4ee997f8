"""The run folder is renamed or removed, or cannot be written for a while, during a run."""

from __future__ import annotations

import logging
import os
import resource
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from feeding import track_frames
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.events import Event, EventKind
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.offline.runner import RunOptions, RunSummary, resume, run
from bmask_slam.run_folder.folder import CHECKPOINT, FILES, RunFolder
from bmask_slam.tracking.results import FrameResult, TrackingStatus

FRAMES = PlaneViews(sideways_path(0.02 * np.arange(16)))


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return make_sequence(tmp_path / "seq")


def frames_in(run: Path) -> list[int]:
    """Indices of the frames in frames.csv."""
    lines = (run / "frames.csv").read_text().splitlines()[1:]
    return [int(line.partition(",")[0]) for line in lines]


def run_with(
    sequence: Path, out: Path, on_frame: Callable[[int], object], **options: object
) -> RunSummary:
    make = partial(FakeSystem, on_frame=on_frame)
    return run(RunOptions(sequence, out=out, quiet=True, **options), make)


def move(source: Path, target: Path) -> None:
    """Rename the folder, through which no name of its files leads any more."""
    target.parent.mkdir(exist_ok=True)
    source.rename(target)


def remove_and_take_its_name(out: Path) -> None:
    shutil.rmtree(out)
    out.mkdir()


FAULTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "renamed": (lambda out: move(out, out.parent / "moved" / "run"), "moved/run"),
    "removed": (shutil.rmtree, "out"),
    "replaced": (remove_and_take_its_name, "out-2"),
    "emptied": (lambda out: [path.unlink() for path in out.iterdir()], "out"),
    "without log": (lambda out: (out / "log.txt").unlink(), "out"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_offline_run_keeps_all(
    sequence: Path, tmp_path: Path, fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    inflict, where = FAULTS[fault]
    out, whole = tmp_path / "out", tmp_path / "whole"
    run_with(sequence, whole, lambda k: None)
    summary = run_with(sequence, out, lambda k: inflict(out) if k == 11 else None)
    assert summary.folder == tmp_path / where
    assert f"now {tmp_path / where}" in caplog.text or f"again to {tmp_path / where}" in caplog.text
    assert sorted(path.name for path in summary.folder.iterdir()) == sorted(FILES)
    for name in ("config.yaml", "trajectory.txt", "keyframes.txt", "events.csv", "map"):
        assert (summary.folder / name).read_bytes() == (whole / name).read_bytes()
    assert frames_in(summary.folder) == list(range(20))
    log = (summary.folder / "log.txt").read_text()
    assert "20 frames; 0 colour" in log and "20 frames in" in log


def test_a_folder_that_is_gone_can_be_resumed_where_it_was_written_again(
    sequence: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"

    def fault(k: int) -> None:
        if k == 8:
            shutil.rmtree(out)
        if k == 15:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_with(sequence, out, fault, checkpoint_every=6)
    assert resume(out, {}, FakeSystem) is not None
    assert frames_in(out) == list(range(20))


def test_no_other_process_writes_into_a_folder_that_was_made_again(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "run") as folder:
        shutil.rmtree(tmp_path / "run")
        assert folder.path == tmp_path / "run"
        with pytest.raises(InputError, match="a process is writing a run there"):
            RunFolder(tmp_path / "run", overwrite=True)


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """No file can grow beyond so many bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("name", ["frames.csv", "events.csv", "log.txt"])
def test_what_a_full_disk_did_not_take_is_written_again_later(tmp_path: Path, name: str) -> None:
    """No half file stands in the way, and no line is lost or cut."""
    event = Event(3, 0.1, EventKind.LOST, "on purpose")
    result = FrameResult(3, 0.1, TrackingStatus.OK, None, events=(event,))
    out = tmp_path / "run"
    with RunFolder(out) as folder:
        for k in range(300):
            folder.write_frame(replace(result, index=k))
            logging.getLogger("bmask_slam").info("a line of the log")
        before = (out / name).read_text()
        (out / name).unlink()
        with full_disk(2000), pytest.raises(OSError, match="too large"):
            folder.write_frame(result)
        names = os.listdir(out)
        folder.write_frame(replace(result, index=300))
    assert len(names) == 2
    assert (out / name).read_text().startswith(before)
    assert frames_in(out) == list(range(301))


def test_a_checkpoint_that_cannot_be_written_does_not_end_the_run(
    sequence: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A folder stands in its way for two of the four that are due."""
    out, present = tmp_path / "out", {}

    def fault(k: int) -> None:
        present[k] = (out / CHECKPOINT).is_file()
        if k == 4:
            (out / CHECKPOINT).unlink()
            (out / CHECKPOINT / "a").mkdir(parents=True)
        if k == 14:
            shutil.rmtree(out / CHECKPOINT)

    summary = run_with(sequence, out, fault, checkpoint_every=6)
    assert (summary.frames, summary.stopped_by) == (20, None)
    assert [text.split(",")[0] for text in summary.warnings] == ["2 checkpoints not written"]
    warnings = [r.message for r in caplog.records if r.levelname == "WARNING"]
    assert sum("tries again at the next checkpoint" in text for text in warnings) == 1
    assert present[3] and not present[14] and present[18]
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)


def test_a_live_run_keeps_all(tmp_path: Path) -> None:
    out, moved = tmp_path / "out", tmp_path / "moved"
    with LiveSlam(CAMERA, None, LiveOptions(out)) as slam:
        track_frames(slam, FRAMES[:5])
        out.rename(moved)
        track_frames(slam, FRAMES[5:9])
        assert slam.out == moved
        assert len(frames_in(moved)) == 9
        shutil.rmtree(moved)
        track_frames(slam, FRAMES[9:])
        assert len(frames_in(moved)) == len(FRAMES)
        shutil.rmtree(moved)
    assert slam.out == moved
    assert len(read_tum(moved / "trajectory.txt")) == len(FRAMES)
    assert len(frames_in(moved)) == len(FRAMES)
    assert {*FILES, "health.json"} <= {path.name for path in moved.iterdir()}


def test_a_live_run_whose_folder_cannot_be_made_again(tmp_path: Path) -> None:
    """A file lies where its parent was: the trajectory is saved elsewhere, as the error says."""
    out = tmp_path / "parent" / "out"
    with LiveSlam(CAMERA, None, LiveOptions(out)) as slam:
        track_frames(slam, FRAMES[:2])
        shutil.rmtree(tmp_path / "parent")
        (tmp_path / "parent").touch()
        track_frames(slam, FRAMES[2:6])
        assert slam.health().unwritten == 4
        with pytest.raises(InputError, match="the whole trajectory is in") as caught:
            slam.close()
    path = Path(str(caught.value).rsplit(" ", 1)[1])
    assert len(read_tum(path)) == 6
    shutil.rmtree(path.parent)
