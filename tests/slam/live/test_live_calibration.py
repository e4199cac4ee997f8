"""A live run finds the times of its camera and goes on with them; map, source and files follow."""

from __future__ import annotations

import os
import shutil
import signal
import time
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from faults import LONG_S
from feeding import track_frames
from recorded_bags import DEPTH, INFO, RGB, BagMaker, image
from shifted_stamps import with_depth_stamps
from synthetic_view import CAMERA, PlaneViews, sideways_path

from bmask_slam.calibration.config import FREE, SelfCalibrationConfig
from bmask_slam.calibration.keyframe_depth import DepthImage, KeyframeImages
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation.ate_rpe import evaluate_trajectory
from bmask_slam.events import EventKind
from bmask_slam.graph.calibration.registration import Registration
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.files.array_file import write_arrays
from bmask_slam.live import live_map, start, system
from bmask_slam.live import play as play_module
from bmask_slam.live.live_slam import LiveSlam
from bmask_slam.live.messages import STATE_FILE, EstimateCamera
from bmask_slam.live.play import PlayOptions, play
from bmask_slam.live.processes import calibration_process, remote_calibration
from bmask_slam.live.processes.calibration_process import CalibrationServer, CalibrationSetup
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.recorded_source import RecordedSource
from bmask_slam.live.start import LiveOptions
from bmask_slam.run_folder.map_file import read_map, read_run
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

CONFIG = resolve(
    SystemConfig, None, ("semantics.segmenter.name=none", "features.max_keypoints=400")
)
DETAILED = resolve(SystemConfig, None, ("semantics.segmenter.name=none",))

STEP_S = 1 / 15


def played(
    sequence: Sequence, out: Path, calibrate: str, config: SystemConfig = CONFIG
) -> LiveSlam:
    source = RecordedSource(sequence, realtime=False)
    options = LiveOptions(out, calibrate=calibrate, straightens=True, pairs=True, interpolates=True)
    with LiveSlam(source.camera, config, options) as slam:
        assert play(slam, source, PlayOptions(realtime=False, quiet=True)) is None
    assert source.camera == slam.camera
    return slam


@pytest.fixture
def short_stretch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few frames, each tracked in the map of all keyframes before it, however long that takes."""
    rules = partial(SelfCalibrationConfig, frames=115)
    monkeypatch.setattr(start, "SelfCalibrationConfig", rules)
    monkeypatch.setattr(play_module, "WAITING", 0)
    monkeypatch.setattr(live_map, "MAX_MAP_WAIT_S", LONG_S)
    monkeypatch.setattr(system, "CALIBRATION_S", LONG_S)  # a busy machine, on which a process of
    monkeypatch.setattr(remote_calibration, "NICENESS", 0)  # low priority would not get far


def test_a_delay_is_found_and_used(late_sweep, sweep_camera, short_stretch, tmp_path) -> None:
    late, delay_s = open_sequence(late_sweep), sweep_camera.depth_time_offset_s
    slam = played(late, tmp_path / "run", "auto", DETAILED)
    assert slam.calibration.endswith("found and applied")
    assert slam.camera.depth_time_offset_s == pytest.approx(delay_s, abs=0.004)
    assert slam.camera.rolling_shutter_s == pytest.approx(0.0, abs=0.002)
    run = tmp_path / "run"
    assert read_camera(run / "camera.yaml") == slam.camera
    assert read_run(run).camera == read_map(run)[1] == slam.camera
    told = played(late, tmp_path / "told", "report", DETAILED)
    assert told.calibration.endswith("found, not applied")
    assert told.camera.depth_time_offset_s == 0 and not (tmp_path / "told/camera.yaml").exists()


def test_rows_that_are_read_upwards_are_noticed(
    turned_sweep, short_stretch, monkeypatch, tmp_path
) -> None:
    """A camera of known readout time is looked at after twice as many frames."""
    rules = partial(SelfCalibrationConfig, frames=57)
    monkeypatch.setattr(start, "SelfCalibrationConfig", rules)
    turned, found = open_sequence(turned_sweep), "as in images turned by 180 degrees: found"
    slam = played(turned, tmp_path / "run", "auto")
    assert f"{found} and applied" in slam.calibration
    assert slam.camera.rolling_shutter_s == -0.02
    assert read_run(tmp_path / "run").camera == slam.camera
    told = played(turned, tmp_path / "told", "report")
    assert told.calibration.endswith(f"{found}, not applied")
    assert told.camera.rolling_shutter_s == 0.02 and not (tmp_path / "told/camera.yaml").exists()


@pytest.fixture
def robot(late_sweep, tmp_path) -> Sequence:
    """The sweep, seen by a robot that sees itself in the lower sixth of the image."""
    folder = shutil.copytree(late_sweep, tmp_path / "robot")
    spots = np.random.default_rng(1).integers(0, 255, (10, 80, 3)).astype(np.uint8)
    body = cv2.resize(spots, (320, 40), interpolation=cv2.INTER_NEAREST)
    for file in sorted((folder / "rgb").iterdir()):
        rgb = cv2.imread(str(file))
        rgb[200:] = body
        cv2.imwrite(str(file), rgb)
    return open_sequence(folder)


def test_a_robot_that_sees_itself_leaves_itself_out(robot, short_stretch, tmp_path) -> None:
    slam = played(robot, tmp_path / "run", "auto")
    ((left, top, right, bottom),) = slam.camera.covered
    assert (left, right, bottom) == (0, 320, 240) and 196 <= top <= 204
    assert "dirt on the lens: left out" in slam.calibration
    run = tmp_path / "run"
    assert read_camera(run / "camera.yaml") == read_map(run)[1] == slam.camera
    anew = [e for e in Run(run).events if e.kind is EventKind.SEGMENT]
    assert len(anew) == 2 and anew[1].timestamp_s < robot.timestamps_s[len(robot) // 2]
    paths = read_run(run).trajectories
    assert paths["trajectory.txt"].timestamps_s[0] == pytest.approx(anew[1].timestamp_s)
    assert robot.groundtruth is not None
    errors = evaluate_trajectory(paths["trajectory.txt"], robot.groundtruth)
    assert errors.value("ate_rmse") < 0.02
    told = played(robot, tmp_path / "told", "report")
    assert told.calibration.endswith("found, not left out") and not told.camera.covered


def test_a_robot_that_is_only_located_keeps_its_map(robot) -> None:
    there = list(robot.frames(stop=20))
    back = [replace(f, timestamp_s=(20 + k) * STEP_S) for k, f in enumerate(there[::-1])]
    seen = replace(robot.camera, covered=((0, 200, 320, 240),)), "a sixth never moves"
    with LiveSlam(robot.camera, CONFIG, LiveOptions()) as slam:
        track_frames(slam, there, waiting=0)
        slam.extends = False
        slam._system.watch = SimpleNamespace(look=lambda frame, camera: seen)
        statuses = track_frames(slam, back)
        assert slam.camera.covered and "left out" in slam.calibration
    assert all(status.by_image for status in statuses)


def test_a_map_that_late_depth_has_bent_begins_anew(
    late_sweep, sweep_camera, short_stretch, monkeypatch, tmp_path
) -> None:
    monkeypatch.setattr(start, "SelfCalibrationConfig", partial(SelfCalibrationConfig, frames=70))
    late = open_sequence(with_depth_stamps(late_sweep, tmp_path / "late", 0.08))
    slam = played(late, tmp_path / "run", "auto")
    right_s = sweep_camera.depth_time_offset_s - 0.08
    assert slam.camera.depth_time_offset_s == pytest.approx(right_s, abs=0.01)
    events = Run(tmp_path / "run").events
    assert [e for e in events if "bent by depth's delay and begins anew" in e.text]
    anew = [e for e in events if e.kind is EventKind.SEGMENT]
    paths = read_run(tmp_path / "run").trajectories
    path, bent = paths["trajectory.txt"], paths["trajectory_segment_0.txt"]
    assert path.timestamps_s[0] == pytest.approx(anew[-1].timestamp_s) and len(path) < len(bent)
    assert late.groundtruth is not None
    errors_m = [evaluate_trajectory(p, late.groundtruth).value("ate_rmse") for p in (path, bent)]
    assert errors_m[0] < min(0.02, errors_m[1])


def test_a_source_that_pairs_images_gets_the_delay_that_edges_show(
    late_sweep, sweep_camera, short_stretch, monkeypatch, tmp_path
) -> None:
    monkeypatch.setattr(start, "SelfCalibrationConfig", partial(SelfCalibrationConfig, frames=80))
    source, lags_s = BagSource(one_frame_late(late_sweep, tmp_path / "late.bag")), []
    assert source.pairs and not source.interpolates
    options = LiveOptions(tmp_path / "run", calibrate="auto", straightens=True, pairs=True)
    with LiveSlam(source.camera, CONFIG, options) as slam:
        for frame in source.frames():
            slam.track(frame.timestamp_s, frame.rgb, frame.depth_m, depth_lag_s=frame.depth_lag_s)
            slam.catch_up(waiting=0)
            source.use(slam.camera)
            lags_s.append(frame.depth_lag_s)
    right_s = sweep_camera.depth_time_offset_s - STEP_S
    assert slam.camera.depth_time_offset_s == pytest.approx(right_s, abs=0.01)
    assert "by edges of depth: found and applied" in (tmp_path / "run/log.txt").read_text()
    assert lags_s[:80] == pytest.approx([0.0] * 80, abs=1e-5)
    assert lags_s[-10:] == pytest.approx([STEP_S] * 10, abs=1e-5)


def one_frame_late(folder: Path, path: Path) -> Path:
    """A bag of a sequence, in which each depth image has the stamp of the next colour image."""
    sequence = open_sequence(folder)
    camera = sequence.camera
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1])
    p = np.insert(k, (3, 6, 9), 0.0)
    size = {"width": camera.width, "height": camera.height}
    about = SimpleNamespace(**size, k=k, p=p, d=np.zeros(5), distortion_model="plumb_bob")
    with closing(sequence.frames()) as frames, BagMaker(path, "sqlite3") as bag:
        bag.write(INFO, 100.0, about)
        for frame in frames:
            stamp_s = 100 + frame.timestamp_s
            bag.write(RGB, stamp_s, image("rgb8", frame.rgb))
            bag.write(DEPTH, stamp_s + STEP_S, image("32FC1", frame.depth_m))
    return path


def test_a_right_camera_stays(late_sweep, sweep_camera, short_stretch, tmp_path) -> None:
    slam = played(open_sequence(late_sweep, camera=sweep_camera), tmp_path / "run", "auto")
    assert slam.camera == sweep_camera
    assert slam.calibration and not (tmp_path / "run" / "camera.yaml").exists()


def test_a_recording_goes_on_with_the_camera_that_is_found(late_sweep, sweep_camera) -> None:
    late = open_sequence(late_sweep)
    source, frames = RecordedSource(late, realtime=False), []
    for frame in source.frames():
        frames.append(frame)
        if len(frames) == 10:
            source.use(sweep_camera)
    stamps_s = np.array([frame.timestamp_s for frame in frames])
    assert len(frames) >= 123 and (np.diff(stamps_s) > 0).all()
    assert {f.depth_lag_s for f in frames[:10]} == {0.0}
    assert np.allclose([f.depth_lag_s for f in frames[11:-1]], -sweep_camera.depth_time_offset_s)


def test_a_calibration_that_has_ended_is_no_process() -> None:
    """Its number may be another process's by then."""
    with LiveSlam(CAMERA, CONFIG, LiveOptions(calibrate="auto")) as slam:
        assert {"map", "calibration"} == slam.processes().keys()
        assert slam._system.calibration is not None
        slam._system.calibration.end()
        assert {"map"} == slam.processes().keys()


def test_a_recording_does_not_wait_for_a_calibration_that_hangs(monkeypatch, caplog) -> None:
    monkeypatch.setattr(remote_calibration, "WAIT_S", 1.0)
    with LiveSlam(CAMERA, CONFIG, LiveOptions(calibrate="auto")) as slam:
        calibration = slam._system.calibration
        os.kill(calibration.pid, signal.SIGSTOP)
        calibration._due = 0
        for _ in range(2):
            begin_s = time.monotonic()
            slam.catch_up(waiting=0)
            assert time.monotonic() - begin_s < LONG_S / 2
        assert caplog.text.count("has not answered for 1 s; tracking goes on") == 1


def test_calibration_gets_depth_as_it_is_tracked(monkeypatch) -> None:
    """A program may write 0 where depth is missing; edges of depth would be around each hole."""
    views, sent = PlaneViews(sideways_path(0.02 * np.arange(4))), []
    with LiveSlam(CAMERA, CONFIG, LiveOptions(calibrate="report")) as slam:
        monkeypatch.setattr(slam._system.calibration._worker, "send", sent.append)
        slam._system.keyframes.decide = lambda tracked: "test"
        for frame in views:
            frame.depth_m[:50] = 0.0
            slam.track(frame.timestamp_s, frame.rgb, frame.depth_m)
    assert len(sent) == 2
    for depth in (sent[0].before, sent[0].depth, sent[0].after):
        assert np.isnan(depth.depth_m[:50]).all() and (depth.depth_m[50:] > 0).all()


def test_an_unknown_choice_is_refused() -> None:
    with pytest.raises(InputError, match="--calibrate on: is not one of auto, report, off"):
        LiveOptions(calibrate="on")


@pytest.mark.parametrize("end", ["not written", "skipped", "given up", "written"])
def test_an_estimate_whose_map_was_not_saved_is_given_up(monkeypatch, end: str) -> None:
    sent: list[object] = []
    process = SimpleNamespace(is_running=True, receive=lambda: [], send=sent.append)
    monkeypatch.setattr(remote_calibration, "Worker", lambda *about: process)
    config = SelfCalibrationConfig(frames=0)
    setup = CalibrationSetup(CAMERA, SmootherConfig(), config, "report", (), pairs=False)
    worker = SimpleNamespace(sent=7, saved=3, state=Path("old"), lacks=lambda after, last: True)
    mapper = SimpleNamespace(worker=worker, handled=6, given_up=False, save_state=lambda: None)
    calibration = remote_calibration.RemoteCalibration(setup)
    calibration.update(mapper)  # asks for a state, by message 7
    calibration.update(mapper)
    assert calibration.busy and not sent
    if end == "skipped":
        worker.lacks = lambda after, last: (after, last) != (6, 7)
    elif end == "given up":
        mapper.given_up = True
    else:
        mapper.handled, worker.saved = 7, 7 if end == "written" else 3
    monkeypatch.setattr(calibration, "_due", 1)
    calibration.update(mapper)
    assert calibration.busy == (end == "written")
    assert sent == ([EstimateCamera(Path("old"))] if end == "written" else [])


def test_a_delay_by_the_motion_that_edges_contradict_is_held_back(
    late_sweep, monkeypatch, tmp_path
) -> None:
    sequence, state = open_sequence(late_sweep), tmp_path / "state.npz"
    images = followed(sequence, state)
    setup = CalibrationSetup(
        sequence.camera, CONFIG.graph, SelfCalibrationConfig(), "auto", FREE, True
    )
    for edges_s, used_s in (0.1, 0.1), (0.04, 0.0), (0.03, 0.016):
        edges = Registration(np.zeros(2), np.ones(2), edges_s, 0.003, 9.0)
        monkeypatch.setattr(calibration_process, "sure_registration", lambda _, found=edges: found)
        server = CalibrationServer(setup)
        for of_keyframe in images:
            server.add(of_keyframe)
        answer = server.estimate(EstimateCamera(state))
        offset_s = 0.0 if answer.camera is None else answer.camera.depth_time_offset_s
        assert offset_s == pytest.approx(used_s, abs=0.004)
        assert ("edges of depth contradict it, not applied" in answer.text) == (used_s == 0)
        if used_s == 0:
            assert not answer.done
            answer = server.estimate(EstimateCamera(state))  # the second look confirms it
            assert answer.camera.depth_time_offset_s == pytest.approx(edges_s, abs=0.001)
            assert "by edges of depth: found and applied" in answer.text


def followed(sequence: Sequence, state: Path) -> list[KeyframeImages]:
    """Run a sequence, write the state of its map, and return the images of its keyframes."""
    system, last, found = SlamSystem(sequence.camera, CONFIG), [], []
    with closing(sequence.frames()) as frames:
        for frame in frames:
            last = [*last[-2:], (frame, system.process(frame).keyframe_id)]
            if len(last) == 3 and last[1][1] is not None:
                found.append(images_of(system, last[1][1], [f for f, _ in last]))
    write_arrays(state, STATE_FILE, {"camera": asdict(sequence.camera)}, system.state())
    return found


def images_of(system: SlamSystem, keyframe_id: int, frames: list[Frame]) -> KeyframeImages:
    """Those of a keyframe, which is the second of three frames."""
    before, depth, after = (DepthImage(f.depth_m, f.timestamp_s) for f in frames)
    pixels = system.map.world.keyframes[keyframe_id].features.image_pixels
    return KeyframeImages(keyframe_id, frames[1].rgb, pixels, depth, before, after, 0.0)
