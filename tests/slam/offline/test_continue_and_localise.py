"""A saved map: another recording continues it, or is localised in it."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from repository import KITCHEN
from synthetic_view import CAMERA, render_plane

from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import read_arrays, write_arrays
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.offline.map_localisation import MapLocalisation
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.run_folder.folder import FILES
from bmask_slam.run_folder.map_file import MAP_FILE, read_map, write_map
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult, TrackingStatus

CONFIG = SystemConfig(FeatureConfig(max_keypoints=400))


def sideways(count: int, start_x_m: float, step_m: float = 0.03) -> list[Array]:
    """Poses along the plane, looking at it."""
    return [se3_exp(np.array([0, 0, 0, start_x_m + step_m * i, 0, 0])) for i in range(count)]


def process_frames(system: SlamSystem, poses: list[Array], first: int = 0) -> list[FrameResult]:
    return [system.process(render_plane(pose, first + i)) for i, pose in enumerate(poses)]


@pytest.fixture(scope="module")
def state() -> Arrays:
    """The map of a plane from x = -1.6 m to -1.

    Its frames begin at stamp 0, as those of every other session here do.
    """
    system = SlamSystem(CAMERA, CONFIG)
    process_frames(system, sideways(20, -1.6))
    system.finish()
    return system.state()


def started(state: Arrays, make: type[SlamSystem] = SlamSystem) -> SlamSystem:
    system = make(CAMERA, CONFIG)
    system.restore({name: array.copy() for name, array in state.items()}, Path("map"))
    system.begin_session()
    return system


def largest_error_m(results: list[FrameResult], poses: list[Array]) -> float:
    """The largest error of frames in the map frame, which is the camera at x = -1.6 m."""
    T_map_plane = inverse(sideways(1, -1.6)[0])
    offsets = [
        se3_log(inverse(T_map_plane @ T) @ r.T_world_camera)[3:]
        for T, r in zip(poses, results, strict=True)
    ]
    return float(np.linalg.norm(offsets, axis=1).max())


def test_a_second_session_continues_in_the_map_frame(state: Arrays) -> None:
    system, poses = started(state), sideways(30, -1.3, 0.05)
    results = process_frames(system, poses)  # most of it beyond what the map knows
    system.finish()
    assert {r.segment for r in results} == {0}
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert largest_error_m(results, poses) < 0.005
    assert len(system.trajectory()) == 30  # of this session alone
    made = [r.keyframe_id for r in results if r.keyframe_id is not None]
    assert len(system.keyframe_trajectory()) == len(made) >= 1
    assert min(made) == int(state["mapper.world.next_keyframe_id"])
    assert {0, *made} <= set(system.mapper.world.keyframes)


def test_an_unrecognised_start_is_a_segment_until_recognised(state: Arrays, caplog) -> None:
    system, poses = started(state), sideways(46, 1.5, -0.06)
    results = process_frames(system, poses[:10])
    assert {r.segment for r in results} == {1}
    assert {r.status for r in results} == {TrackingStatus.OK}
    apart = started(system.state())  # and a third session knows both
    assert sorted({k.segment for k in apart.mapper.world.keyframes.values()}) == [0, 1]
    results += process_frames(system, poses[10:], first=10)
    assert results[-1].segment == 0
    system.finish()
    assert "no frame was recognised" not in caplog.text
    assert len(system.trajectory()) == len(results)
    assert largest_error_m(results[-1:], poses[-1:]) < 0.02


def test_a_session_elsewhere_reports_its_own_frame(state: Arrays, caplog) -> None:
    system = started(state)
    process_frames(system, sideways(6, 1.5))
    system.finish()
    assert "no frame was recognised in the map" in caplog.text
    assert "the trajectory has its own coordinate frame" in caplog.text


def test_localisation_finds_every_frame_and_changes_nothing(state: Arrays) -> None:
    system = started(state, MapLocalisation)
    poses = sideways(12, -1.55, 0.045)
    results = process_frames(system, poses)
    system.finish()
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert largest_error_m(results, poses) < 0.005
    assert {r.keyframe_id for r in results} == {None}
    poses_of_map = part_of_state(system.state())
    for name, array in part_of_state(state).items():
        np.testing.assert_array_equal(array, poses_of_map[name])
    assert system.files() == {}
    assert len(system.trajectory()) == 12
    assert len(system.keyframe_trajectory()) == 0


def test_odometry_leads_on_where_the_map_does_not_show(state: Arrays) -> None:
    system = started(state, MapLocalisation)
    poses = sideways(20, -1.55, 0.03)
    frames = [render_plane(pose, k) for k, pose in enumerate(poses)]
    for k in range(6, 14):
        frames[k] = replace(frames[k], rgb=np.zeros_like(frames[k].rgb))
    system.add_odometry([f.timestamp_s for f in frames], np.array(poses))
    results = [system.process(frame) for frame in frames]
    by_odometry = [TrackingStatus.DEAD_RECKONING] * 8
    assert [r.status for r in results[6:14]] == by_odometry
    assert {r.status for r in results[:6] + results[14:]} == {TrackingStatus.OK}
    assert largest_error_m(results, poses) < 0.005
    assert len(system.trajectory()) == 20


def part_of_state(state: Arrays) -> Arrays:
    """The map without search counters of landmarks."""
    counters = ("visible", "found")
    kept = ("mapper.world", "mapper.graph")
    return {k: a for k, a in state.items() if k.startswith(kept) and not k.endswith(counters)}


def test_localisation_elsewhere_is_lost_and_reported(state: Arrays) -> None:
    system = started(state, MapLocalisation)
    poses = [*sideways(3, 1.6), *sideways(5, -1.4)]
    results = process_frames(system, poses)
    assert [r.status for r in results] == [TrackingStatus.LOST] * 3 + [TrackingStatus.OK] * 5
    assert [r.T_world_camera is None for r in results] == [True] * 3 + [False] * 5
    assert len(system.trajectory()) == 5
    assert largest_error_m(results[3:], poses[3:]) < 0.005


def test_a_map_is_read_back_from_file_and_folder(state: Arrays, tmp_path: Path) -> None:
    write_map(tmp_path / "map", state, CAMERA)
    for path in (tmp_path, tmp_path / "map"):
        found, camera = read_map(path)
        assert camera == CAMERA
        assert all(found[name].tobytes() == array.tobytes() for name, array in state.items())


def test_files_that_are_not_maps_are_rejected(state: Arrays, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"map: there is no saved map here"):
        read_map(tmp_path)
    write_map(tmp_path / "map", SlamSystem(CAMERA).state(), CAMERA)
    with pytest.raises(InputError, match=r"map: holds no keyframe"):
        read_map(tmp_path)
    write_map(tmp_path / "map", state, CAMERA)
    header, arrays = read_arrays(tmp_path / "map", MAP_FILE)
    write_arrays(tmp_path / "newer", replace(MAP_FILE, version=7), header, arrays)
    with pytest.raises(InputError, match=r"newer: holds 'bmask-slam map' version \d, expected"):
        read_map(tmp_path / "newer")
    del arrays["mapper.feed.removed"]
    with pytest.raises(InputError, match=r"map: array 'mapper.feed.removed' is missing"):
        SlamSystem(CAMERA).restore(arrays, tmp_path / "map")


def test_a_map_of_another_camera_is_not_continued(state: Arrays, tmp_path: Path) -> None:
    write_map(tmp_path / "map", state, CAMERA)
    options = RunOptions(make_sequence(tmp_path / "seq"), out=tmp_path / "out", quiet=True)
    words = r"map: made with another camera .*seq \(.*fx 525\.0 and 30\.0, .* \(--localise accepts"
    with pytest.raises(InputError, match=words):
        run(replace(options, map=tmp_path / "map"), FakeSystem)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("use", ["map", "localise", "camera"])
def test_what_a_run_begins_with_is_not_overwritten(use: str, tmp_path: Path) -> None:
    folder = tmp_path / "old"
    run(RunOptions(make_sequence(tmp_path / "seq"), out=folder, quiet=True), FakeSystem)
    shutil.copy(tmp_path / "seq/camera.yaml", folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    given = folder / "camera.yaml" if use == "camera" else folder
    options = RunOptions(tmp_path / "seq", out=folder, overwrite=True, quiet=True)
    with pytest.raises(InputError, match=f"{given}: is an input, which stays as it is; choose"):
        run(replace(options, **{use: given}), FakeSystem)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("other", "flag"),
    [("map", "continue"), ("dense", "map"), ("checkpoint_every", "checkpoint-every")],
)
def test_localisation_excludes_options_that_extend_the_map(other: str, flag: str) -> None:
    with pytest.raises(InputError, match=f"--localise m: does not .*, which --{flag} needs"):
        RunOptions(Path("x"), localise=Path("m"), **{other: 7})


def test_a_map_that_is_only_searched_has_no_covariances() -> None:
    with pytest.raises(InputError, match=r"--localise m: does not .*, which --covariances needs"):
        RunOptions(Path("x"), SystemConfig(covariances=True), localise=Path("m"))


def cut_out(folder: Path, frames: range, margin_px: int = 0) -> Path:
    """Some frames of the kitchen as a sequence with smaller images."""
    inside = slice(margin_px, -margin_px or None)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
        lines = (KITCHEN / f"{kind}.txt").read_text().splitlines()[1:]  # without the comment
        (folder / f"{kind}.txt").write_text("\n".join(lines[i] for i in frames) + "\n")
        for name in (lines[i].split()[1] for i in frames):
            image = cv2.imread(str(KITCHEN / name), cv2.IMREAD_UNCHANGED)[inside, inside]
            cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_JPEG_QUALITY, 100])
    camera = (KITCHEN / "camera.yaml").read_text()
    for old, new in (("640", 640), ("480", 480), ("321.42", 321.42), ("237.05", 237.05)):
        less = margin_px * (2 if isinstance(new, int) else 1)
        camera = camera.replace(f" {old}\n", f" {new - less}\n")
    (folder / "camera.yaml").write_text(camera)
    (folder / "groundtruth.txt").symlink_to(KITCHEN / "groundtruth.txt")
    return folder


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="no ../shared/data/redkitchen here")
def test_real_frames_continue_and_are_localised_in_one_frame(tmp_path: Path) -> None:
    first = cut_out(tmp_path / "first", range(24))
    run(RunOptions(first, CONFIG, out=tmp_path / "old", quiet=True))
    saved = (tmp_path / "old/map").read_bytes()
    second = cut_out(tmp_path / "second", range(18, 36))
    run(RunOptions(second, CONFIG, out=tmp_path / "new", map=tmp_path / "old", quiet=True))
    small = cut_out(tmp_path / "small", range(3, 24, 3), margin_px=40)
    run(
        RunOptions(small, CONFIG, out=tmp_path / "found", localise=tmp_path / "old/map", quiet=True)
    )
    truth = read_tum(KITCHEN / "groundtruth.txt")
    start = inverse(truth.poses_world_camera[0])
    for name, stamps in (("new", second), ("found", small)):
        found = read_tum(tmp_path / name / "trajectory.txt")
        index = np.rint(found.timestamps_s * 30).astype(int)
        assert len(found) == len((stamps / "rgb.txt").read_text().splitlines())
        error = inverse(start @ truth.poses_world_camera[index]) @ found.poses_world_camera
        assert np.linalg.norm(error[:, :3, 3], axis=1).max() < 0.05  # no alignment: one frame
    assert (tmp_path / "old/map").read_bytes() == saved
    assert {p.name for p in (tmp_path / "found").iterdir()} == {*FILES} - {"map", "graph"}
