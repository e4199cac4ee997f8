"""Checkpoints: a run killed at any moment and resumed equals an uninterrupted one."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence, signal_at
from faults import untimed_files

from bmask_slam.cli import main
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import plot
from bmask_slam.events import EventKind, read_events
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.runner import RunOptions, resume, run
from bmask_slam.run_folder.folder import CHECKPOINT, FILES, GROWING, RunFolder
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.config import TrackingConfig

EVERY = 6


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return make_sequence(tmp_path / "seq")


@pytest.fixture(autouse=True)
def quick_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))


def options(sequence: Path, out: Path, **more: object) -> RunOptions:
    return RunOptions(sequence, out=out, quiet=True, checkpoint_every=EVERY, **more)


def killed(work: Callable[[], object]) -> bool:
    """Run a function in a process of its own; returns whether it was killed."""
    child = os.fork()
    if child == 0:
        try:
            work()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


def kill_at_rename(monkeypatch: pytest.MonkeyPatch, number: int, after: bool) -> None:
    """Kill this process before or after it renames the n-th file to its final name."""
    renames = iter(range(1, 1000))
    rename = os.replace

    def fatal(source: Path, target: Path) -> None:
        last = next(renames) == number
        if not last or after:
            rename(source, target)
        if last:
            os.kill(os.getpid(), signal.SIGKILL)

    monkeypatch.setattr(os, "replace", fatal)


def test_killed_at_every_rename_and_resumed(
    sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files change their contents at renames only, but for frames.csv and log.txt, which grow."""
    run(options(sequence, tmp_path / "undisturbed"), FakeSystem)
    expected, kills, before_any = untimed_files(tmp_path / "undisturbed"), 0, 0
    for number in range(1, 100):
        for after in (False, True):
            out = tmp_path / f"{number}-{after}"
            with monkeypatch.context() as patch:
                kill_at_rename(patch, number, after)
                if not killed(lambda out=out: run(options(sequence, out), FakeSystem)):
                    assert kills > 20
                    assert before_any == 3
                    return
            kills += 1
            if not (out / CHECKPOINT).exists():
                before_any += 1
                with pytest.raises(InputError, match="holds no checkpoint"):
                    resume(out, make_system=FakeSystem)
                continue
            assert resume(out, make_system=FakeSystem) is not None
            assert untimed_files(out) == expected


@pytest.mark.parametrize("frame", [0, 5, 6, 7, 19])
def test_killed_in_a_frame_twice_and_resumed(sequence: Path, tmp_path: Path, frame: int) -> None:
    run(options(sequence, tmp_path / "undisturbed", stride=2, max_frames=9), FakeSystem)
    deadly = partial(FakeSystem, on_frame=signal_at(frame, signal.SIGKILL))
    out = tmp_path / "out"
    first = options(sequence, out, stride=2, max_frames=9)
    was_killed = killed(lambda: run(first, deadly))
    assert was_killed == (frame < 18 and frame % 2 == 0)
    if was_killed:
        assert killed(lambda: resume(out, make_system=deadly))
        assert resume(out, make_system=FakeSystem) is not None
    assert untimed_files(out) == untimed_files(tmp_path / "undisturbed")


def test_counts_and_broken_frames_are_carried_over(sequence: Path, tmp_path: Path, capsys) -> None:
    for k in (2, 9):
        (sequence / f"rgb/{k}.png").write_bytes(b"no image")
    deadly = partial(FakeSystem, on_frame=signal_at(15, signal.SIGKILL))
    assert killed(lambda: run(options(sequence, tmp_path / "a"), deadly))
    summary = resume(tmp_path / "a", {"quiet": False}, FakeSystem)
    whole = run(options(sequence, tmp_path / "b"), FakeSystem)
    assert (summary.frames, summary.skipped) == (whole.frames, whole.skipped) == (18, 2)
    names = ("tracked_share", "ate_rmse", "keyframes")
    found, expected = ({r["name"]: r["value"] for r in s.rows} for s in (summary, whole))
    assert [found[name] for name in names] == [expected[name] for name in names]
    bar = capsys.readouterr().err
    assert "70%" in bar  # 12 frames and two broken ones are at the 14th of 20
    assert "2 lost" in bar  # of which one before the kill
    log = (tmp_path / "a/log.txt").read_text()
    assert "resumed after 12 frames" in log
    assert "checkpoint after 18 frames" in log


def test_nothing_is_saved_or_restarted_without_the_option(sequence: Path, tmp_path: Path) -> None:
    systems: list[FakeSystem] = []

    def make(*arguments: object) -> FakeSystem:
        systems.append(FakeSystem(*arguments))
        return systems[-1]

    run(RunOptions(sequence, out=tmp_path / "plain", quiet=True), make)
    run(options(sequence, tmp_path / "often"), make)
    assert [system.restarts for system in systems] == [0, 5]  # begin, 6, 12, 18, end


def test_a_finished_run_is_not_changed(sequence: Path, tmp_path: Path) -> None:
    run(options(sequence, tmp_path / "out"), FakeSystem)
    before = {path: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    assert sorted(path.name for path in before) == sorted(FILES)
    assert resume(tmp_path / "out", make_system=FakeSystem) is None
    assert {path: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


def test_a_stopped_run_is_complete_and_can_be_resumed(sequence: Path, tmp_path: Path) -> None:
    stopped = partial(FakeSystem, on_frame=signal_at(9, signal.SIGINT))
    summary = run(options(sequence, tmp_path / "out"), stopped)
    assert (summary.stopped_by, summary.frames, summary.resumable) == (signal.SIGINT, 10, True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {*FILES, CHECKPOINT}
    summary = resume(tmp_path / "out", make_system=FakeSystem)
    assert (summary.stopped_by, summary.frames, summary.resumable) == (None, 20, False)
    run(options(sequence, tmp_path / "whole"), FakeSystem)
    assert untimed_files(tmp_path / "out") == untimed_files(tmp_path / "whole")


@pytest.fixture
def begun(sequence: Path, tmp_path: Path) -> Path:
    """A run that was killed at frame 13, with a checkpoint after 12."""
    deadly = partial(FakeSystem, on_frame=signal_at(13, signal.SIGKILL))
    assert killed(lambda: run(options(sequence, tmp_path / "out", stride=1), deadly))
    return tmp_path / "out"


@pytest.fixture
def refused(begun: Path, sequence: Path) -> Iterator[Callable[..., None]]:
    """Check that resuming fails with a message and does not change the run folder."""

    def check(message: str, given: dict[str, object] | None = None) -> None:
        before = {path: path.read_bytes() for path in begun.iterdir()}
        with pytest.raises(InputError, match=message):
            resume(begun, given, FakeSystem)
        assert {path: path.read_bytes() for path in begun.iterdir()} == before

    yield check


def test_a_moved_sequence_and_equal_options_are_accepted(begun: Path, sequence: Path) -> None:
    moved = sequence.rename(sequence.with_name("moved"))
    given = {"sequence": moved, "stride": 1, "checkpoint_every": EVERY, "out": begun}
    assert resume(begun, given, FakeSystem).frames == 20


def test_another_sequence_is_refused(begun: Path, sequence: Path, refused) -> None:
    shorter = make_sequence(sequence.with_name("shorter"), 19)
    refused(r"shorter: not the frames that the run was started with", {"sequence": shorter})
    camera = (sequence / "camera.yaml").read_text()
    (sequence / "camera.yaml").write_text(camera.replace("fx: 30", "fx: 30.5"))
    refused(r"seq: not the camera that the run was started with")
    shutil.rmtree(sequence)
    refused(r"seq: no such folder")


def test_what_the_run_was_started_without_is_said_in_words(begun: Path, refused) -> None:
    said = "the run was started without"
    refused(f"--max-frames: {said} --max-frames; omit it", {"max_frames": 100})
    refused(f"--map: {said} --map; omit it", {"dense": True})
    refused(f"--mesh-voxel: {said} --mesh-voxel; omit it", {"mesh_voxel_m": 0.03})


def test_a_checkpoint_with_the_size_of_a_map_that_is_not_made_is_resumed(sequence: Path) -> None:
    """Such options were ignored once."""
    recorded = RunOptions(sequence).recorded() | {"mesh_voxel_m": 0.03}
    assert RunOptions.from_recorded(recorded, SystemConfig(), Path("run")).mesh_voxel_m is None


@pytest.mark.parametrize("segmenter", [SystemConfig().semantics.segmenter.name, "truth"])
def test_another_segmenter_is_refused_also_the_default(
    sequence: Path, tmp_path: Path, capsys, segmenter: str
) -> None:
    config = resolve(SystemConfig, None, ["semantics.segmenter.name=precomputed"])
    stopped = partial(FakeSystem, on_frame=signal_at(9, signal.SIGINT))
    out = run(options(sequence, tmp_path / "out", config=config), stopped).folder
    assert main(["run", "--resume", str(out), "--segmenter", segmenter]) == 1
    assert "--config: the run was started with another conf" in capsys.readouterr().err


def test_other_options_are_refused(begun: Path, refused) -> None:
    refused(r"--stride: the run was started with 1; omit it", {"stride": 3})
    refused(r"--out: the run was started with .*out; omit", {"out": begun.parent})
    refused(r"--continue: the run was started with None", {"map": begun.parent})
    other = SystemConfig(tracking=TrackingConfig(min_inliers=41))
    refused(r"--config: the run was started with another configuration", {"config": other})
    (begun / "config.yaml").write_text("{tracking: {min_inliers: 41}}")
    refused(r"config\.yaml: not the configuration that checkpoint was made with")


def test_a_frames_file_of_another_run_is_rejected(begun: Path, refused) -> None:
    whole = (begun / "frames.csv").read_text()
    (begun / "frames.csv").write_text(whole[:300])
    refused(r"frames\.csv: not the file of the checkpoint, which has at least \d+ bytes")
    (begun / "frames.csv").write_text(whole.replace("matches", "guesses"))
    refused(r"and the columns index,timestamp,status")
    (begun / "frames.csv").unlink()
    refused(r"frames\.csv: not the file")


def test_an_events_file_that_is_not_the_checkpoints_is_refused(begun: Path, refused) -> None:
    (begun / "events.csv").write_text("index,timestamp,kind\n" * 20)
    refused(r"events\.csv: not the file of the checkpoint, .* columns index,timestamp,kind,text;")


def test_a_checkpoint_of_a_version_without_events_is_resumed(begun: Path) -> None:
    """Its folder has no events.csv; what happened before the checkpoint is not known."""
    rewrite_header(begun / CHECKPOINT, lambda header: header.pop("events_bytes"))
    (begun / "events.csv").unlink()
    assert resume(begun, make_system=FakeSystem).frames == 20
    assert [(e.frame, e.kind) for e in read_events(begun)] == [
        (13, EventKind.LOST),
        (14, EventKind.FOUND),
        (19, EventKind.LOOP_REMOVED),
    ]


def test_events_are_the_same_after_a_kill_in_a_loss(sequence: Path, tmp_path: Path) -> None:
    """Frame 6 is lost and the checkpoint is after it: frame 7 is told to be found again."""
    every = partial(RunOptions, sequence, quiet=True, checkpoint_every=7)
    run(every(out=tmp_path / "whole"), FakeSystem)
    deadly = partial(FakeSystem, on_frame=signal_at(9, signal.SIGKILL))
    assert killed(lambda: run(every(out=tmp_path / "out"), deadly))
    resume(tmp_path / "out", make_system=FakeSystem)
    whole = (tmp_path / "whole/events.csv").read_bytes()
    assert (tmp_path / "out/events.csv").read_bytes() == whole
    assert b"7,0.700000,found again" in whole


@pytest.mark.parametrize("length", [0, 50, -1])
def test_a_damaged_checkpoint_is_refused(begun: Path, refused, length: int) -> None:
    path = begun / CHECKPOINT
    path.write_bytes(path.read_bytes()[:length])
    refused(r"out/checkpoint: not a saved checkpoint, or a damaged one")


def test_a_foreign_checkpoint_is_refused(begun: Path, refused) -> None:
    def rewrite(**changes: object) -> None:
        rewrite_header(begun / CHECKPOINT, lambda header: header.update(changes))

    rewrite(counters={})
    rewrite(options={"sequence": "x"})
    refused(r"out/checkpoint: its header cannot be read")
    rewrite(frames_bytes=float("inf"))
    refused(r"out/checkpoint: its header cannot be read")
    rewrite(version=99)
    refused(r"out/checkpoint: holds 'bmask-slam checkpoint' version 99, expected")
    rewrite(format="bmask-slam map")
    refused(r"out/checkpoint: holds 'bmask-slam map' version 99, expected")


def test_the_systems_arrays_are_checked(begun: Path) -> None:
    """The real system rejects the fake one's state."""
    with pytest.raises(InputError, match=r"out/checkpoint: array '[\w.]+' is \w+; save it again"):
        resume(begun)


def test_a_folder_in_use_is_refused(begun: Path, sequence: Path, refused) -> None:
    other = RunFolder(begun, resume_bytes={n: (begun / n).stat().st_size for n in GROWING})
    refused(r"out: a process is writing a run there; wait for it")
    with pytest.raises(InputError, match=r"a process is writing a run there"):
        run(replace(options(sequence, begun), overwrite=True), FakeSystem)
    other.__exit__(None, None, None)
    with pytest.raises(InputError, match=r"already holds a run .checkpoint.; go on with --resume"):
        run(options(sequence, begun), FakeSystem)
    assert run(replace(options(sequence, begun), overwrite=True), FakeSystem).frames == 20


def test_a_run_without_checkpoints_cannot_be_resumed(sequence: Path, tmp_path: Path) -> None:
    deadly = partial(FakeSystem, on_frame=signal_at(13, signal.SIGKILL))
    plain = RunOptions(sequence, out=tmp_path / "out", quiet=True)
    assert killed(lambda: run(plain, deadly))
    with pytest.raises(InputError, match=r"out: holds no checkpoint, .* with --overwrite"):
        resume(tmp_path / "out", make_system=FakeSystem)


def rewrite_header(path: Path, change: Callable[[dict[str, object]], object]) -> None:
    with np.load(path) as file:
        arrays = dict(file)
    header = json.loads(str(arrays["header"]))
    change(header)
    with path.open("wb") as file:
        np.savez(file, **{**arrays, "header": json.dumps(header)})
