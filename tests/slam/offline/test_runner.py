"""The runner with a fake system with known poses: files, metrics, stops and errors."""

from __future__ import annotations

import csv
import errno
import importlib.metadata
import json
import logging
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence, signal_at, true_trajectory
from repository import ROOT, SHARED

from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import plot
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.offline.runner import RunOptions, RunSummary, run
from bmask_slam.run_folder.folder import FILES
from bmask_slam.run_folder.origin import find_sequence
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.config import TrackingConfig

METRICS = [
    "tracked_share",
    "ate_rmse",
    "rpe_trans_rmse_frame",
    "rpe_rot_rmse_frame",
    "rpe_trans_rmse_second",
    "rpe_rot_rmse_second",
    "tracking_ms_median",
    "tracking_ms_p95",
    "frames_per_second",
    "keyframes",
    "landmarks",
    "loops_closed",
    "isam2_update_ms_median",
    "isam2_update_ms_p95",
    "peak_rss_mb",
]


DRAW = plot.plot_trajectory


@pytest.fixture(autouse=True)
def quick_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Most of the time of a run of the fake system is that of its picture."""
    monkeypatch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return make_sequence(tmp_path / "seq")


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


def values(summary: RunSummary) -> dict[str, float]:
    return {row["name"]: row["value"] for row in summary.rows}


def fake_run(sequence: Path, out: Path, **options: object) -> RunSummary:
    return run(RunOptions(sequence, out=out, quiet=True, **options), FakeSystem)


def test_a_run_writes_all_documented_files(
    sequence: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plot, "plot_trajectory", DRAW)
    config = SystemConfig(tracking=TrackingConfig(min_inliers=41))
    summary = fake_run(sequence, out, config=config)
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)  # and nothing temporary
    assert resolve(SystemConfig, out / "config.yaml") == config
    tracked = [k for k in range(20) if k % 7 != 6]
    np.testing.assert_allclose(read_tum(out / "trajectory.txt").timestamps_s * 10, tracked)
    np.testing.assert_allclose(read_tum(out / "keyframes.txt").timestamps_s * 10, [0, 5, 10, 15])
    assert (out / "graph").read_bytes() == b"graph"
    assert (out / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    assert json.loads((out / "metrics.json").read_text()) == summary.rows
    assert "Python" in (out / "log.txt").read_text()
    assert (summary.frames, summary.skipped, summary.stopped_by) == (20, 0, None)


def test_the_size_of_a_dense_map_without_one_is_refused(sequence: Path, out: Path) -> None:
    with pytest.raises(InputError, match=r"--mesh-voxel 0\.03: is for the dense map; give --map"):
        fake_run(sequence, out, mesh_voxel_m=0.03)
    assert not out.exists()


def test_a_relative_sequence_is_recorded_by_its_absolute_path(
    sequence: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(sequence.parent)
    fake_run(Path(sequence.name), out)
    monkeypatch.chdir("/")
    assert find_sequence(out) == sequence
    assert f", sequence {sequence}, stride 1" in (out / "config.yaml").read_text()


def test_a_library_that_another_package_has_is_no_hindrance(
    sequence: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV may come from conda or from another of its packages."""
    find = importlib.metadata.distribution

    def others(name: str) -> importlib.metadata.Distribution:
        if name.startswith("opencv"):
            raise importlib.metadata.PackageNotFoundError(name)
        return find(name)

    monkeypatch.setattr(importlib.metadata, "distribution", others)
    fake_run(sequence, out)
    assert re.search(r"gtsam [0-9.]+, numpy [0-9.]+$", (out / "log.txt").read_text(), re.MULTILINE)


def test_frames_csv(sequence: Path, out: Path) -> None:
    fake_run(sequence, out)
    with (out / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["index"]) for row in rows] == list(range(20))
    row = rows[15]
    assert (row["timestamp"], row["status"], row["matches"]) == ("1.500000", "OK", "115")
    assert (row["inliers"], row["keyframe"], row["keyframe_reason"]) == ("105", "3", "new view")
    assert (row["tracking_ms"], row["graph_ms"]) == ("1015.000", "7000000.000")
    assert (rows[6]["status"], rows[6]["keyframe"]) == ("LOST", "")


def test_landmarks_are_read_back(sequence: Path, out: Path) -> None:
    fake_run(sequence, out)
    columns = read_ply(out / "landmarks.ply")
    assert columns["y"].tolist() == [2.0, 5.25]
    assert columns["blue"].tolist() == [2, 250]
    assert columns["observations"].tolist() == [2, 300]
    assert columns["id"].tolist() == [3, 8]


def test_metrics_are_complete_and_correct(sequence: Path, out: Path) -> None:
    options = RunOptions(sequence, out=out, quiet=True)
    summary = run(options, partial(FakeSystem, z_error_m=0.02))
    found = values(summary)
    graph = {name: found.pop(name) for name in list(found) if name.startswith("graph_")}
    assert graph == {"graph_factors_refused": 3, "graph_factors_refused_loop_not_finite": 2}
    assert list(found) == [name for name in METRICS if name != "rpe_rot_rmse_frame"]
    assert found["tracked_share"] == pytest.approx(18 / 20)
    assert found["ate_rmse"] == pytest.approx(0.01, rel=0.02)  # +-1 cm about the mean plane
    assert found["tracking_ms_median"] == pytest.approx(1009.5, abs=5)  # without keyframe, graph
    assert found["isam2_update_ms_median"] == 2.0
    assert found["isam2_update_ms_p95"] == pytest.approx(8.3)
    assert 20 < found["peak_rss_mb"] < 10_000


def test_without_reference_there_are_no_errors(
    tmp_path: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plot, "plot_trajectory", DRAW)
    summary = fake_run(make_sequence(tmp_path / "seq", truth=False), out)
    assert [n for n in values(summary) if n.startswith(("ate", "rpe"))] == []
    assert values(summary)["tracked_share"] == pytest.approx(0.9)
    assert (out / "trajectory.png").exists()


def test_stride_and_max_frames(sequence: Path, out: Path) -> None:
    summary = fake_run(sequence, out, stride=3, max_frames=5)
    stamps = read_tum(out / "trajectory.txt").timestamps_s
    np.testing.assert_allclose(stamps * 10, [0, 3, 9, 12])  # 6 is lost
    assert summary.frames == 5
    assert values(summary)["tracked_share"] == pytest.approx(4 / 5)


def test_a_broken_frame_is_skipped_and_counts_as_untracked(sequence: Path, out: Path) -> None:
    (sequence / "rgb/4.png").write_bytes(b"no image")
    summary = fake_run(sequence, out)
    assert (summary.frames, summary.skipped) == (19, 1)
    assert values(summary)["tracked_share"] == pytest.approx(17 / 20)
    assert "frame 4 skipped" in (out / "log.txt").read_text()


def test_warnings_at_opening_are_in_the_log(sequence: Path, out: Path) -> None:
    (sequence / "rgb/4.png").unlink()
    with (sequence / "rgb.txt").open("a") as file:
        file.write("77.0 rgb/1.png\n")
    fake_run(sequence, out)
    log = (out / "log.txt").read_text()
    assert "frame 4 is broken" in log
    assert "1 colour and 0 depth images without a partner" in log
    assert "camera.yaml: Camera(width=32" in log


def test_a_clock_that_was_set_back_is_said(sequence: Path, out: Path) -> None:
    assert fake_run(sequence, out).warnings == ()
    for name in ("rgb.txt", "depth.txt"):
        rows = [line.split() for line in (sequence / name).read_text().splitlines()]
        rows = [(float(row[0]), row[1]) for row in rows if row[0] != "#"]
        back_s = 7.5 * (rows[1][0] - rows[0][0])
        lines = [f"{s - back_s * (k >= 10):.6f} {file}\n" for k, (s, file) in enumerate(rows)]
        (sequence / name).write_text("".join(lines))
    text, of_depth = fake_run(sequence, out, overwrite=True).warnings
    assert "depth.txt: the stamps go back by" in of_depth
    assert "rgb.txt: the stamps go back by" in text
    assert text in (out / "log.txt").read_text()


def test_another_reference(sequence: Path, out: Path, tmp_path: Path) -> None:
    truth = true_trajectory(20)
    poses = truth.poses_world_camera.copy()
    poses[::2, 2, 3] += 0.06
    write_tum(tmp_path / "other.txt", Trajectory(truth.timestamps_s, poses))
    found = values(fake_run(sequence, out, reference=tmp_path / "other.txt"))
    assert found["ate_rmse"] == pytest.approx(0.03, rel=0.02)


def test_a_reference_of_another_time_is_rejected_before_the_run(
    sequence: Path, out: Path, tmp_path: Path
) -> None:
    truth = true_trajectory(20)
    write_tum(tmp_path / "late.txt", Trajectory(truth.timestamps_s + 5, truth.poses_world_camera))
    with pytest.raises(InputError, match=r"late\.txt: .* give the reference of this sequence"):
        fake_run(sequence, out, reference=tmp_path / "late.txt")
    assert not out.exists()


def test_a_run_without_poses_finishes(sequence: Path, out: Path, caplog) -> None:
    class Lost(FakeSystem):
        def number(self, frame):
            return 6  # a number that is lost

    summary = run(RunOptions(sequence, out=out, quiet=True), Lost)
    assert values(summary)["tracked_share"] == 0
    assert "no comparison with the reference" in caplog.text
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_run_with_everything_saved(
    sequence: Path, out: Path, number: signal.Signals
) -> None:
    before = signal.getsignal(number)
    options = RunOptions(sequence, out=out, quiet=True)
    summary = run(options, partial(FakeSystem, on_frame=signal_at(9, number)))
    assert (summary.stopped_by, summary.frames) == (number, 10)
    assert values(summary)["tracked_share"] == pytest.approx(9 / 10)  # of the frames given
    assert sorted(p.name for p in out.iterdir()) == sorted(FILES)
    assert len(read_tum(out / "trajectory.txt")) == 9
    assert signal.getsignal(number) is before


def test_a_second_interrupt_quits_at_once(sequence: Path, out: Path) -> None:
    usual = signal.default_int_handler  # a shell's background job, as these tests may be, has none
    before = signal.signal(signal.SIGINT, usual)

    def twice(k: int) -> None:
        if k == 9:
            os.kill(os.getpid(), signal.SIGINT)
            while signal.getsignal(signal.SIGINT) is not usual:  # two at once could become one
                time.sleep(0.001)
            os.kill(os.getpid(), signal.SIGINT)

    try:
        with pytest.raises(KeyboardInterrupt):
            run(RunOptions(sequence, out=out, quiet=True), partial(FakeSystem, on_frame=twice))
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_killed_run_keeps_its_written_frames(tmp_path: Path, out: Path) -> None:
    sequence = make_sequence(tmp_path / "seq", 50)
    code = (
        "import sys; from functools import partial; from pathlib import Path; import signal\n"
        "from fake_run import FakeSystem, signal_at; "
        "from bmask_slam.offline.runner import RunOptions, run\n"
        "options = RunOptions(Path(sys.argv[1]), out=Path(sys.argv[2]), quiet=True)\n"
        "run(options, partial(FakeSystem, on_frame=signal_at(40, signal.SIGKILL)))\n"
    )
    paths = [str(ROOT / "tests" / "helpers"), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    command = [sys.executable, "-c", code, str(sequence), str(out)]
    done = subprocess.run(command, env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    assert len((out / "frames.csv").read_text().splitlines()) == 1 + 40
    assert len(read_tum(out / "trajectory.txt")) == 26  # of the first 30 frames 4 were lost
    resolve(SystemConfig, out / "config.yaml")
    assert "camera" in (out / "log.txt").read_text()
    with pytest.raises(InputError, match="already holds a run"):
        fake_run(sequence, out)
    assert fake_run(sequence, out, overwrite=True).frames == 50


def test_too_many_broken_frames_keep_what_was_tracked(sequence: Path, out: Path) -> None:
    for k in range(12, 20):
        (sequence / f"rgb/{k}.png").write_bytes(b"no image")
    with pytest.raises(InputError, match="frames are broken"):
        fake_run(sequence, out)
    assert len(read_tum(out / "trajectory.txt")) == 11
    assert "stopped: " in (out / "log.txt").read_text()


def test_an_input_error_before_the_first_frame_leaves_no_folder(
    sequence: Path, tmp_path: Path
) -> None:
    def refuse(k: int) -> None:
        raise InputError("first frame unusable")

    options = RunOptions(sequence, out=tmp_path / "new/deep/run", quiet=True)
    with pytest.raises(InputError, match="unusable"):
        run(options, partial(FakeSystem, on_frame=refuse))
    assert not (tmp_path / "new").exists()


def test_a_bug_is_in_the_log_with_its_traceback(sequence: Path, out: Path) -> None:
    def fail(k: int) -> None:
        if k == 3:
            raise ZeroDivisionError("planted")

    level = logging.getLogger("bmask_slam").level
    with pytest.raises(ZeroDivisionError):
        run(RunOptions(sequence, out=out, quiet=True), partial(FakeSystem, on_frame=fail))
    assert "Traceback" in (out / "log.txt").read_text()
    assert logging.getLogger("bmask_slam").level == level
    assert logging.getLogger("bmask_slam").handlers == []


def test_a_full_disk_is_reported_and_written_files_are_kept(sequence: Path, out: Path) -> None:
    class Full(FakeSystem):
        def save(self, path: Path, name: str) -> None:
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(InputError, match=r"out: No space left on device; free some space"):
        run(RunOptions(sequence, out=out, quiet=True), Full)
    assert len(read_tum(out / "trajectory.txt")) == 18


def test_run_folders_are_numbered(sequence: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = RunOptions(sequence, quiet=True)
    folders = [str(run(options, FakeSystem).folder) for _ in range(2)]
    named = RunOptions(sequence, quiet=True, config_name="paper")
    folders.append(str(run(named, FakeSystem).folder))
    assert folders == ["runs/seq", "runs/seq-2", "runs/seq-paper"]


@pytest.mark.parametrize(("option", "value"), [("stride", 0), ("max_frames", 0), ("stride", -1)])
def test_impossible_options(option: str, value: int) -> None:
    name = option.replace("_", "-")
    with pytest.raises(InputError, match=f"--{name} {value}: must be a whole number"):
        RunOptions(Path("x"), **{option: value})


def test_real_frames_twice_give_the_same_bytes(tmp_path: Path) -> None:
    kitchen = SHARED / "redkitchen"
    if not kitchen.is_dir():
        pytest.skip("no ../shared/data/redkitchen here")
    options = RunOptions(kitchen, max_frames=20, quiet=True)
    summaries = [run(replace(options, out=tmp_path / name)) for name in "ab"]
    for name in ("trajectory.txt", "keyframes.txt", "landmarks.ply", "graph"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert values(summaries[0])["tracked_share"] == 1
    assert values(summaries[0])["ate_rmse"] < 0.02


class FakeSegments(FakeSystem):
    """Its frames from the tenth on are a map segment of their own, which is never joined."""

    def segments(self) -> dict[int, Trajectory]:
        path, first = super().trajectory(), np.array(self.numbers) < 10
        return {0: path.select(np.flatnonzero(first)), 1: path.select(np.flatnonzero(~first))}

    def trajectory(self) -> Trajectory:
        return self.segments()[0]

    def keyframe_trajectory(self) -> Trajectory:
        return self.trajectory().select(np.arange(0, 9, 5))


def test_map_segments_that_were_never_joined_are_said(
    sequence: Path, out: Path, caplog: pytest.LogCaptureFixture
) -> None:
    summary = run(RunOptions(sequence, out=out, quiet=True), FakeSegments)
    told = "map: 9 of 18 frames with a pose are in 1 segments that were never recognised in the"
    (warning,) = (text for text in summary.warnings if text.startswith("map:"))
    assert warning.startswith(told) and "(trajectory_segment_1.txt)" in warning
    assert warning in caplog.messages and warning in (out / "log.txt").read_text()
    assert len(read_tum(out / "trajectory_segment_1.txt")) == 9
    assert not [text for text in fake_run(sequence, out, overwrite=True).warnings if "map:" in text]
