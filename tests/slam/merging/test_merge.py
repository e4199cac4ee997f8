"""Finished runs merged: two walks along one plane, and what is refused."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane, sideways_path

from bmask_slam import cli
from bmask_slam.config.configuration import dump
from bmask_slam.evaluation import plot
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.merging import merge
from bmask_slam.merging.joining import join_objects
from bmask_slam.merging.joint_state import Shift
from bmask_slam.merging.merge import MergeOptions, merge_runs
from bmask_slam.merging.report import MergeSummary, format_merge
from bmask_slam.run_folder import metrics
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.map_file import read_map, write_map
from bmask_slam.run_folder.reader import Run
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.keyframe_decision import KeyframeConfig
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.world_map import WorldMap

PLACE = se3_exp(np.array([0.0, 0.0, 0.3, 0.2, 0.1, 0.0]))
"""The second walk's camera is turned about its axis and begins elsewhere."""
FRAMES = 9
FIRST_M, SECOND_M = np.linspace(-1.7, -0.6, FRAMES), np.linspace(-1.4, -0.3, FRAMES)
FAR_M = np.linspace(1.5, 1.7, 3)
FEATURES = FeatureConfig(max_keypoints=400)
OFTEN = KeyframeConfig(min_interval_frames=1, late_frames=2, late_shared=1.0)
WALKS = {
    "first": sideways_path(FIRST_M),
    "second": [T @ PLACE for T in sideways_path(SECOND_M)],
    "far": sideways_path(FAR_M),
}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run of each walk; the frames of each begin at stamp 0."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        for name, poses in WALKS.items():
            system = SlamSystem(CAMERA, SystemConfig(FEATURES, keyframes=OFTEN))
            with RunFolder(folder / name) as run:
                run.write_text("config.yaml", f"# bmask-slam 0, live\n{dump(system.config)}")
                for index, T in enumerate(poses):
                    run.write_frame(system.process(render_plane(T, index)))
                system.finish()
                metrics.save(system, run, [], None, name)
    return folder


@pytest.fixture(scope="module")
def merged(runs: Path) -> MergeSummary:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        return merge_runs(MergeOptions((runs / "first", runs / "second"), runs / "merged"))


def test_both_walks_are_where_they_were_in_one_world(merged: MergeSummary) -> None:
    for number, name in enumerate(("first", "second"), 1):
        found = read_tum(merged.folder / f"trajectory_run_{number}.txt")
        true = inverse(WALKS["first"][0]) @ np.array(WALKS[name])
        errors = se3_log(inverse(true) @ found.poses_world_camera)
        assert np.abs(errors[:, 3:]).max() < 0.01
        assert np.abs(errors[:, :3]).max() < 0.005
        assert found.timestamps_s == pytest.approx(np.arange(FRAMES) / 30, abs=1e-6)


def test_what_both_saw_is_there_once(merged: MergeSummary, runs: Path) -> None:
    alone = [len(Run(runs / name).landmarks.ids) for name in ("first", "second")]
    together = len(Run(merged.folder).landmarks.ids)
    assert max(alone) < together < 0.9 * sum(alone)
    values = Run(merged.folder).metrics
    assert values["merge_loops"].value >= 6
    assert values["merge_loops_wrong"].value == 0
    assert values["merge_loop_rms_m"].value < 0.01


def test_objects_of_map_segments_that_are_not_joined_stay_apart() -> None:
    seen: list[tuple[list[int], int]] = []
    world = SimpleNamespace(
        keyframes={
            k: SimpleNamespace(id=k, segment=segment, T_world_camera=np.eye(4))
            for k, segment in enumerate((0, 2, 0))
        }
    )

    def join(poses: dict[int, Any], first: int, _end: int) -> int:
        seen.append((sorted(poses), first))
        return 1

    semantics = SimpleNamespace(objects=SimpleNamespace(join=join), follow_map=lambda: None)
    system: Any = SimpleNamespace(semantics=semantics, map=SimpleNamespace(world=world))
    assert join_objects(system, [0, 7]) == 2
    assert seen == [([0, 2], 7), ([1], 7)]


def test_the_segment_of_a_run_that_is_joined_is_that_of_its_trajectory() -> None:
    """It has most frames; another one has more keyframes. The second run has one segment."""
    world, history = WorldMap(), FrameHistory()
    for number, segment in enumerate((0, 0, 1, 2)):
        keyframe: Any = SimpleNamespace(id=number, segment=segment, T_world_camera=np.eye(4))
        world.keyframes[number] = keyframe
    for k, keyframe_id in enumerate((0, 1, 2, 2, 2, 3)):
        history.append(0.1 * k, keyframe_id, np.eye(4), np.eye(4))
    system: Any = SimpleNamespace(map=SimpleNamespace(world=world, history=history))
    sources: Any = [SimpleNamespace(shift=Shift(keyframes=first)) for first in (0, 3)]
    assert merge._largest_segments(system, sources) == [1, 2]


def test_the_result_is_one_run(merged: MergeSummary, runs: Path) -> None:
    run = Run(merged.folder)
    first, second = (Run(runs / name) for name in ("first", "second"))
    assert len(run.frames) == len(run.trajectory) == 2 * FRAMES
    assert (np.diff(run.frames.index) == 1).all()
    made = run.frames.keyframe_ids[run.frames.keyframe_ids >= 0]
    assert len(made) == len(np.unique(made)) == len(first.keyframes) + len(second.keyframes)
    assert (run.keyframes.ids >= 0).all()
    assert run.is_finished
    with (merged.folder / "events.csv").open(newline="") as file:
        assert {"new segment", "loop closed"} <= {row["kind"] for row in csv.DictReader(file)}


def test_the_map_is_tracked_in_from_both_walks(merged: MergeSummary) -> None:
    state, camera = read_map(merged.folder)
    system = SlamSystem(camera)
    system.restore(state, merged.folder)
    system.begin_session()
    for index, x_m in enumerate((-1.5, -1.47, -1.44)):
        result = system.process(render_plane(sideways_path(np.array([x_m]))[0], index))
    assert result.segment == 0
    expected = inverse(WALKS["first"][0]) @ sideways_path(np.array([-1.44]))[0]
    assert result.T_world_camera == pytest.approx(expected, abs=0.01)


def test_a_run_that_continued_another_is_merged(runs: Path, tmp_path: Path) -> None:
    """Keyframes of the recording that it continued are of another clock: they have no stamp."""
    state, camera = read_map(runs / "first")
    system = SlamSystem(camera, SystemConfig(FEATURES, keyframes=OFTEN, covariances=True))
    system.restore(state, runs / "first")
    system.begin_session()
    with pytest.MonkeyPatch.context() as patch, RunFolder(tmp_path / "continued") as run:
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        run.write_text("config.yaml", f"# bmask-slam 0, live\n{dump(system.config)}")
        for index, T in enumerate(sideways_path(np.linspace(-1.5, -0.4, FRAMES))):
            run.write_frame(system.process(render_plane(T, index)))
        system.finish()
        metrics.save(system, run, [], None, "continued")
        own = len(system.keyframe_trajectory())
        done = merge_runs(MergeOptions((run.path, runs / "second"), tmp_path / "both"))
    both, keyframes = Run(done.folder), len(Run(runs / "second").keyframes)
    assert len(both.trajectory) == 2 * FRAMES
    assert len(both.keyframes) == own + keyframes
    assert np.isfinite(both.keyframes.timestamps_s).all()
    kept = len(Run(runs / "first").keyframes) + own + keyframes
    assert both.metrics["keyframes"].value == kept
    assert np.isfinite(both.keyframe_covariances).all()
    true = inverse(WALKS["first"][0]) @ np.array(WALKS["second"])
    found = read_tum(done.folder / "trajectory_run_2.txt").poses_world_camera
    assert np.abs(se3_log(inverse(true) @ found)).max() < 0.01


def test_a_run_that_is_in_the_other_one_is_refused(
    runs: Path, merged: MergeSummary, tmp_path: Path
) -> None:
    """A copy, and a merged run beside one of those that it was made of."""
    copy = shutil.copytree(runs / "first", tmp_path / "copy")
    for other in (copy, merged.folder):
        with pytest.raises(InputError, match=rf"{other}: \d+ keyframes are in .*first too, so"):
            merge_runs(MergeOptions((runs / "first", other), tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_run_without_a_common_place_is_named(runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"far: has no place in common with the other runs"):
        merge_runs(MergeOptions((runs / "first", runs / "far"), out))
    assert not out.exists()
    before = shutil.copytree(runs / "second", out)
    with pytest.raises(InputError, match="has no place in common"):
        merge_runs(MergeOptions((runs / "first", runs / "far"), out, overwrite=True))
    assert (before / "map").read_bytes() == (runs / "second" / "map").read_bytes()


def test_what_cannot_be_merged_is_refused(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    state, camera = read_map(runs / "second")
    other = shutil.copytree(runs / "second", tmp_path / "other")
    write_map(other / "map", state, replace(camera, fx=500.0))
    unfinished = shutil.copytree(runs / "second", tmp_path / "unfinished")
    (unfinished / "map").unlink()
    for given, text in (
        ([other], "made with another camera (fx 500.0)"),
        ([unfinished], "holds no map, so it is not a finished run"),
        ([unfinished], "run the sequence again, without --localise"),
        ([runs / "first"], "given twice"),
        ([], "give two runs or more"),
        ([tmp_path / "nothing"], "no such folder"),
    ):
        words = ["merge", *map(str, [runs / "first", *given]), "--out", str(tmp_path / "out")]
        assert cli.main(words) == 1
        error = capsys.readouterr().err
        assert text in error
        assert error.count("\n") == 1
    assert cli.main(["merge", str(runs / "first"), str(other), "--out", str(other)]) == 1


def test_frames_that_are_not_the_maps_are_refused(runs: Path, tmp_path: Path) -> None:
    header, *rows = (runs / "second" / "frames.csv").read_text().splitlines()
    assert rows[4].startswith("4,0.133333,")
    broken = shutil.copytree(runs / "second", tmp_path / "broken")
    for row in ("4,nan,", "4,,", ",0.133333,", "4,9.0,", "0,0.133333,"):
        wrong = [*rows[:4], row + rows[4].split(",", 2)[2], *rows[5:]]
        (broken / "frames.csv").write_text("\n".join([header, *wrong, ""]))
        with pytest.raises(InputError, match="not those of the map"):
            merge_runs(MergeOptions((runs / "first", broken), tmp_path / "out"))
    (broken / "frames.csv").write_text("\n".join([header, *rows[4:], ""]))
    with pytest.raises(InputError, match="not those of the map"):
        merge_runs(MergeOptions((runs / "first", broken), tmp_path / "out"))


def test_recordings_are_listed_where_they_are_known(merged: MergeSummary) -> None:
    assert not (merged.folder / "recordings.json").exists()  # these runs were live
    assert "live" in (merged.folder / "config.yaml").read_text().splitlines()[0]
    assert json.loads((merged.folder / "metrics.json").read_text())


def test_a_run_whose_stamps_are_moved_is_said(merged: MergeSummary) -> None:
    (line,) = (line for line in merged.lines if "stamps" in line)
    assert line.startswith("second: +11 s to its stamps in trajectory.txt")
    assert line in format_merge(merged).splitlines()
