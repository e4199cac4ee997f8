"""The live loop on rendered views: as accurate as offline, and robust to crashed processes."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import faiss
import numpy as np
import pytest
from faults import children, wait_until
from feeding import track_frames
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array, Arrays
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.labelling.results import LandmarkCloud
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.messages import NewKeyframe
from bmask_slam.live.processes import worker
from bmask_slam.live.processes.map_worker import MAX_CRASHES, MapWorker
from bmask_slam.live.processes.remote_dense import RemoteDenseMapper
from bmask_slam.live.processes.remote_mapper import RemoteMapper
from bmask_slam.live.processes.segmentation import RemoteSegmenter
from bmask_slam.live.processes.supervision import RestartPolicy
from bmask_slam.live.system import FINISH_KEYFRAME_S, FINISH_S
from bmask_slam.run_folder.folder import HEALTH
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus

SETTINGS = ["keyframes.min_interval_frames=2", "keyframes.max_shared=0.9"]
CONFIG = resolve(SystemConfig, None, SETTINGS)
TRUTH = sideways_path(0.02 * np.arange(30))
FRAMES = PlaneViews(TRUTH)


def error_m(poses: Array, first: int = 0) -> float:
    """RMS position error of poses (N, 4, 4) in the first one's frame, against the truth."""
    truth = np.array([inverse(TRUTH[first]) @ pose for pose in TRUTH[first : first + len(poses)]])
    found = inverse(poses[0]) @ poses
    return float(np.sqrt(np.mean(np.sum((found - truth)[:, :3, 3] ** 2, axis=1))))


@pytest.fixture(scope="module")
def offline() -> SlamSystem:
    system = SlamSystem(CAMERA, CONFIG)
    for frame in FRAMES:
        system.process(frame)
    system.finish()
    return system


def test_live_is_as_good_as_offline_and_leaves_the_same_files(tmp_path, offline) -> None:
    before = children()
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        assert set(track_frames(slam, FRAMES)) == {TrackingStatus.OK}
        assert len(children() - before) == 1
        cloud, health = slam.map(), slam.health()
        assert len(slam.trajectory()) == len(FRAMES)
    assert children() == before
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    assert len(trajectory) == len(FRAMES)
    allowed = 1.5 * error_m(offline.trajectory().poses_world_camera) + 1e-3
    assert error_m(trajectory.poses_world_camera) < allowed
    turns = trajectory.poses_world_camera[:, :3, :3]
    np.testing.assert_allclose(
        turns @ turns.transpose(0, 2, 1), np.eye(3)[None] + 0 * turns, atol=1e-6
    )
    assert isinstance(cloud, LandmarkCloud)
    assert len(cloud.ids) == health.landmarks > 100
    assert (health.frames, health.lost_frames, health.map_deaths) == (len(FRAMES), 0, 0)
    files = {path.name for path in (tmp_path / "run").iterdir()}
    assert {"graph", "map", "metrics.json", "landmarks.ply", "keyframes.txt", HEALTH} <= files
    assert not any(name.startswith(".") for name in files)
    names = {row["name"] for row in json.loads((tmp_path / "run" / "metrics.json").read_text())}
    assert {"latency_ms_median", "frames_dropped", "isam2_update_ms_median"} <= names


def test_poses_are_filtered_as_the_camera_moves_unless_that_is_switched_off() -> None:
    found = {}
    for smooth in (True, False):
        with LiveSlam(CAMERA, replace(CONFIG, smooth_trajectory=smooth)) as slam:
            found[smooth] = [slam.track(f.timestamp_s, f.rgb, f.depth_m) for f in FRAMES]
    assert all(result.velocity is None for result in found[False])
    velocity, step_s = found[True][-1].velocity, FRAMES[1].timestamp_s - FRAMES[0].timestamp_s
    assert velocity is not None
    assert velocity.twist[3] == pytest.approx(0.02 / step_s, rel=0.05)  # 2 cm a frame along x
    assert error_m(np.array([result.T_world_camera for result in found[True]])) < 0.01


def test_a_map_is_saved_where_the_program_is_when_it_asks(tmp_path, monkeypatch) -> None:
    (tmp_path / "begin").mkdir()
    (tmp_path / "later").mkdir()
    monkeypatch.chdir(tmp_path / "begin")
    with LiveSlam(CAMERA, CONFIG) as slam:
        track_frames(slam, FRAMES[:3])
        monkeypatch.chdir(tmp_path / "later")
        slam.save_map(Path("map"))
        saved = []
        wait_until(lambda: slam.catch_up() or saved.extend(slam.saved_maps()) or saved)
    assert [(s.path, s.failure) for s in saved] == [(tmp_path / "later" / "map", "")]
    assert (tmp_path / "later" / "map").exists()


def test_frames_after_the_end_are_refused_in_one_line(caplog) -> None:
    with LiveSlam(CAMERA, CONFIG) as slam:
        pass
    with pytest.raises(InputError, match="track: this LiveSlam is closed; track frames in its"):
        track_frames(slam, FRAMES[2:3])
    assert not caplog.records


def test_a_killed_map_process_is_restarted_without_losing_frames(tmp_path) -> None:
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES[:12])
        os.kill(slam.processes()["map"], signal.SIGKILL)
        assert set(track_frames(slam, FRAMES[12:])) == {TrackingStatus.OK}
        health = slam.health()
    assert health.map_deaths == 1
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    assert len(trajectory) == len(FRAMES)
    assert error_m(trajectory.poses_world_camera) < 0.02
    assert (tmp_path / "run" / "map").stat().st_size > 10_000


@contextmanager
def stopped(process: int) -> Iterator[None]:
    """A process that does not run for a while."""
    os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process, signal.SIGCONT)


def test_tracking_goes_on_in_new_places_while_the_map_does_not_answer(tmp_path) -> None:
    """Landmarks of new keyframes are tracked before the map has made them, and are then its own."""
    x_m = np.linspace(-1.6, 1.6, 33)  # the view is 2.4 m wide
    views = PlaneViews([se3_exp(np.array([0, 0, 0, x, 0, 0])) for x in x_m])
    with LiveSlam(CAMERA, None, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, views[:1])
        wait_for_the_map(slam)
        remote = slam._system.remote
        with stopped(slam.processes()["map"]):
            assert TrackingStatus.LOST not in track_frames(slam, views[1:], waiting=99)
            assert remote.pending
            ahead = remote.landmarks_ahead
        wait_for_the_map(slam)
        assert slam.health().map_deaths == 0
        assert len(remote.landmarks_ahead) == 0 < len(ahead)
        landmarks = remote.world.landmarks  # of the map now; others were fused into these
        assert len(landmarks.remaining(landmarks.current(ahead))) > 0.7 * len(ahead)
    found = read_tum(tmp_path / "run" / "trajectory.txt").poses_world_camera
    np.testing.assert_allclose(found[:, 0, 3], x_m - x_m[0], atol=0.02)
    np.testing.assert_allclose(found[:, 1:3, 3], 0, atol=0.02)


def wait_for_death(slam: LiveSlam, number: int) -> None:
    wait_until(lambda: slam.catch_up() or slam.health().map_deaths >= number)


def kill_until_it_is_given_up(slam: LiveSlam) -> None:
    for _ in range(MAX_CRASHES):
        os.kill(slam.processes()["map"], signal.SIGKILL)
        wait_for_death(slam, slam.health().map_deaths + 1)


def test_a_map_process_that_is_killed_again_and_again_is_tried_once_more(tmp_path) -> None:
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES[:8])
        kill_until_it_is_given_up(slam)
        for frame in FRAMES[8:12]:
            assert slam.track(frame.timestamp_s, frame.rgb, frame.depth_m).keyframe_id is None
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) == 12
    assert len(read_tum(tmp_path / "run" / "keyframes.txt")) > 1
    assert (tmp_path / "run" / "map").is_file()


def test_every_pose_is_saved_if_the_map_is_lost(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(MapWorker, "try_again", lambda worker: None)
    run = tmp_path / "run"
    with (
        pytest.raises(InputError, match="the map is lost; all poses, and"),
        LiveSlam(CAMERA, CONFIG, LiveOptions(run)) as slam,
    ):
        track_frames(slam, FRAMES[:8])
        wait_for_the_map(slam)
        kill_until_it_is_given_up(slam)
        track_frames(slam, FRAMES[8:12])
    assert len(read_tum(run / "trajectory.txt")) == 12
    assert len(read_tum(run / "keyframes.txt")) > 1
    assert (run / "landmarks.ply").stat().st_size > 1000


def test_the_last_optimisation_of_a_larger_map_may_take_longer(tmp_path, monkeypatch) -> None:
    """Ended after a fixed time, the map of a run of hours would be lost."""
    limits_s: list[float] = []
    finish = RemoteMapper.finish

    def told(mapper: RemoteMapper, timeout_s: float, frames: Arrays) -> Path:
        limits_s.append((timeout_s - FINISH_S) / len(mapper.world.keyframes))
        return finish(mapper, timeout_s, frames)

    monkeypatch.setattr(RemoteMapper, "finish", told)
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES[:6])
        wait_for_the_map(slam)
    assert limits_s == pytest.approx([FINISH_KEYFRAME_S])


def poison_next_keyframe(slam: LiveSlam, monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The next keyframe's message kills the map's process; the list gets its id."""
    remote, poisoned = slam._system.remote, []
    send = remote.send

    def poison(message: object) -> None:
        if isinstance(message, NewKeyframe) and not poisoned:
            poisoned.append(message.id)
            message = replace(message, visibility=None)
        send(message)

    monkeypatch.setattr(remote, "send", poison)
    return poisoned


def wait_for_the_map(slam: LiveSlam) -> None:
    wait_until(lambda: slam.catch_up() or not slam.health().keyframes_waiting)


def test_a_keyframe_that_crashes_the_map_process_is_skipped(tmp_path, monkeypatch) -> None:
    """Also on a machine so busy that the process has not ended when it is looked at."""
    monkeypatch.setattr(worker, "ENDING_S", 0.0)
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        track_frames(slam, FRAMES[:6])
        poisoned = poison_next_keyframe(slam, monkeypatch)
        assert set(track_frames(slam, FRAMES[6:])) == {TrackingStatus.OK}
        wait_for_the_map(slam)
        assert slam.health().map_deaths == 2
        assert poisoned[0] not in slam._system.remote.world.keyframes
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    assert len(trajectory) == len(FRAMES)
    assert error_m(trajectory.poses_world_camera) < 0.02


def test_the_frame_of_a_first_keyframe_that_crashes_the_map_is_saved_apart(
    tmp_path, monkeypatch
) -> None:
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        poison_next_keyframe(slam, monkeypatch)
        track_frames(slam, FRAMES[:1])
        wait_for_the_map(slam)
        assert slam.health().map_deaths == 2
        assert len(slam.trajectory()) == 0
        assert set(track_frames(slam, FRAMES[1:])) == {TrackingStatus.OK}
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    assert len(trajectory) == len(FRAMES) - 1
    assert error_m(trajectory.poses_world_camera, first=1) < 0.02
    (apart,) = (tmp_path / "run").glob("trajectory_segment_*.txt")
    assert read_tum(apart).timestamps_s.tolist() == [FRAMES[0].timestamp_s]


def test_broken_frames_count_in_the_tracked_share_as_in_an_offline_run(tmp_path) -> None:
    with LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run")) as slam:
        slam.source_counts.broken = 1
        track_frames(slam, FRAMES[:4])
        with pytest.raises(InputError, match="resize it"):
            slam.track(FRAMES[4].timestamp_s, FRAMES[4].rgb[:-2], FRAMES[4].depth_m)
        track_frames(slam, FRAMES[5:7])
    shares = [row["value"] for row in slam.rows if row["name"] == "tracked_share"]
    assert shares == [pytest.approx(6 / 8)]


def test_frames_that_cannot_be_used_are_refused_and_the_next_is_tracked() -> None:
    first, second = FRAMES[:2]
    with LiveSlam(CAMERA, CONFIG) as slam:
        begun = slam.track(first.timestamp_s, first.rgb, first.depth_m)
        assert begun.covariance is None
        for rgb, depth_m, stamp_s, words in (
            (second.rgb[:, :, 0], second.depth_m, 1.0, "colour is uint8"),
            (second.rgb, (1000 * np.nan_to_num(second.depth_m)).astype(np.uint16), 1.0, "metres"),
            (second.rgb, second.depth_m[:100], 1.0, "registered"),
            (second.rgb, second.depth_m, first.timestamp_s, "not later"),
            (second.rgb, second.depth_m, float("nan"), "not a finite"),
        ):
            with pytest.raises(InputError, match=words):
                slam.track(stamp_s, rgb, depth_m)
        result = slam.track(1.0, second.rgb, second.depth_m)
        assert result.status is TrackingStatus.OK
        assert result.covariance is not None
        sigmas = np.sqrt(np.diag(result.covariance))
        assert (sigmas[:3] < 0.01).all()
        assert (sigmas[3:] < 0.02).all()
        assert (sigmas > 1e-6).all()
        assert slam.health().frames_refused == 5


def test_black_frames_are_lost_and_tracking_recovers() -> None:
    black = np.zeros_like(FRAMES[0].rgb)
    nothing = np.full_like(FRAMES[0].depth_m, np.nan)
    with LiveSlam(CAMERA, CONFIG) as slam:
        track_frames(slam, FRAMES[:10])
        for k in range(3):
            result = slam.track(FRAMES[9].timestamp_s + 0.01 * (k + 1), black, nothing)
            assert result.status is TrackingStatus.LOST
        assert track_frames(slam, FRAMES[11:13])[-1] is TrackingStatus.OK
        health = slam.health()
    assert (health.lost_frames, health.lost_episodes) == (3, 1)


def settings() -> tuple[float, int, bool]:
    """The settings; of frozen objects only whether there are any."""
    return sys.getswitchinterval(), faiss.omp_get_max_threads(), gc.get_freeze_count() > 0


@pytest.mark.parametrize("frozen", [False, True])
def test_the_callers_settings_are_restored(frozen: bool) -> None:
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(2)
    if frozen:
        gc.freeze()
    try:
        before = settings()
        with LiveSlam(CAMERA, CONFIG):
            assert settings() != before
        assert settings() == before
    finally:
        gc.unfreeze()
        faiss.omp_set_num_threads(threads)


def test_a_dense_process_that_cannot_start_leaves_no_processes(tmp_path, monkeypatch) -> None:
    def late(_: RemoteDenseMapper) -> None:
        raise InputError("the dense mapper's process did not start")

    monkeypatch.setattr(RemoteDenseMapper, "wait_until_ready", late)
    before, processes = settings(), children()
    with pytest.raises(InputError, match="did not start"):
        LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path / "run", dense=True))
    assert settings() == before
    assert children() == processes


def test_a_run_folder_in_use_is_refused_and_nothing_starts(tmp_path) -> None:
    (tmp_path / "frames.csv").write_text("")
    before = children()
    with pytest.raises(InputError, match="already holds a run"):
        LiveSlam(CAMERA, CONFIG, LiveOptions(tmp_path))
    assert children() == before


def test_a_segmenter_that_cannot_start_reports_the_reason(tmp_path) -> None:
    options = SegmenterOptions("precomputed", masks=tmp_path / "none.json")
    with pytest.raises(InputError, match=r"none\.json"):
        RemoteSegmenter(options, tmp_path)


def test_a_run_that_cannot_start_leaves_no_run_folder(tmp_path) -> None:
    segmenter = SegmenterOptions("precomputed", masks=tmp_path / "none.json")
    config = replace(CONFIG, semantics=replace(CONFIG.semantics, segmenter=segmenter))
    with pytest.raises(InputError, match=r"none\.json"):
        LiveSlam(CAMERA, config, LiveOptions(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_process_that_starts_too_late_is_reported(tmp_path, monkeypatch) -> None:
    silent = partial(subprocess.Popen, ["sleep", "600"])
    monkeypatch.setattr(worker, "_started", lambda _, files: silent(pass_fds=files))
    before = children()
    with pytest.raises(InputError, match="segmenter's process has not begun within 0 s"):
        RemoteSegmenter(SegmenterOptions("none"), tmp_path, policy=RestartPolicy(start_s=0.0))
    assert children() == before


@pytest.mark.parametrize("full_size", [False, True])
def test_large_frames_of_a_program_are_reduced(tmp_path, full_size: bool) -> None:
    large = CAMERA.of_size(2 * CAMERA.width, 2 * CAMERA.height)
    options = LiveOptions(tmp_path / "run", full_size=full_size)
    ones = np.ones((2, 2))
    with LiveSlam(large, CONFIG, options) as slam:
        assert slam.camera.recorded() == large
        assert slam.camera.width == (large.width if full_size else large.width // 2)
        for frame in FRAMES[:6]:
            rgb = np.kron(frame.rgb, ones[..., None]).astype(np.uint8)
            depth_m = np.kron(frame.depth_m, ones).astype(np.float32)
            prepared = slam.prepare(rgb, depth_m) if frame.index % 2 else None
            result = slam.track(frame.timestamp_s, rgb, depth_m, prepared)
            assert result.status is TrackingStatus.OK
        with pytest.raises(InputError, match=rf"gives uint8 \({large.height}, {large.width}, 3\)"):
            slam.track(FRAMES[6].timestamp_s, FRAMES[6].rgb, FRAMES[6].depth_m)
        assert slam.health().frames_refused == 1
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    assert error_m(trajectory.poses_world_camera) < 0.02
