"""Self-calibration in a run: observability, adoption, resuming and continuing."""

from __future__ import annotations

import dataclasses
import json
import shutil
import weakref
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from shifted_stamps import with_depth_stamps

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.calibration.adoption import (
    Estimate,
    SelfCalibration,
    camera_with,
    format_found,
    judged,
    surely_other,
)
from bmask_slam.calibration.camera_check import CameraCheck
from bmask_slam.calibration.config import BENDS, FREE, SelfCalibrationConfig, estimated_priors
from bmask_slam.calibration.motion import twists_at
from bmask_slam.calibration.report import parameters_named
from bmask_slam.commands.arguments import camera_lines
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import plot
from bmask_slam.events import EventKind
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.calibration.cross_validation import CrossValidation
from bmask_slam.graph.calibration.model import BEND, LENS, PARAMETERS, SHUTTER, TIME
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.mask_memory import MaskMemory, RememberingSegmenter
from bmask_slam.offline import checkpoint, frame_loop, run_end, runner
from bmask_slam.offline.inherited_camera import (
    inherited_calibration,
    recorded_motions,
    use_own_camera,
)
from bmask_slam.offline.runner import RunOptions, RunSummary, resume, run
from bmask_slam.offline.self_calibration import SelfCalibrator
from bmask_slam.parallel.system import ParallelSystems
from bmask_slam.run_folder.map_file import read_run
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.instances.surfaces import Segmented, up_of
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.semantics.segmenters.upright import Upright
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.sequences.formats.layouts import open_recording
from bmask_slam.sequences.recording import Recording
from bmask_slam.sequences.sequence import Sequence, open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

CONFIG = resolve(
    SystemConfig, None, ("semantics.segmenter.name=none", "features.max_keypoints=400")
)
DETAILED = resolve(SystemConfig, None, ("semantics.segmenter.name=none",))
FRAMES = 90
"""The fewest that are looked at."""
KILLED = (5, 7)
"""Before the checkpoint of 80 frames, and before that of the new beginning."""


@contextmanager
def short_ends() -> Iterator[None]:
    """Ends runs without the picture and the check of the camera, which are tested elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_end, "_camera_checked", lambda _: CameraCheck((), (), ()))
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        yield


@pytest.fixture
def quick() -> Iterator[None]:
    with short_ends():
        yield


@pytest.fixture(scope="module")
def found(late_sweep: Path, tmp_path_factory: pytest.TempPathFactory) -> RunSummary:
    """A run with checkpoints that finds the delay.

    Beside it lie copies of its folder as a kill would leave it, before (odd) and after (even
    numbers) each checkpoint of KILLED. What comes right after one has nothing to take back.
    """
    out, written = tmp_path_factory.mktemp("found") / "run", 0
    write = checkpoint.write_checkpoint

    def copied(path: Path, content: checkpoint.Checkpoint) -> None:
        nonlocal written
        written += 1
        for number in (2 * written - 1, 2 * written):
            if number == 2 * written:
                write(path, content)
            if number in KILLED:
                shutil.copytree(out, out.with_name(f"killed-{number}"))

    with short_ends(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("bmask_slam.offline.checkpoint.write_checkpoint", copied)
        return run(late_options(late_sweep, out))


def late_options(sequence: Path, out: Path) -> RunOptions:
    return RunOptions(sequence, CONFIG, quiet=True, checkpoint_every=40, out=out, max_frames=FRAMES)


def test_the_next_run_of_the_camera_is_told_it(
    found: RunSummary, late_sweep: Path, quick: None, tmp_path: Path
) -> None:
    told, option = camera_lines(found.calibration, found.folder)
    assert told == f"Camera      {found.calibration}"
    path = found.folder / "camera.yaml"
    assert option.split(": ")[0] == f"            --camera {path}"
    done = run(replace(late_options(late_sweep, tmp_path / "next"), camera=path))
    assert done.calibration.endswith("the camera keeps it")
    assert "begins anew" not in (done.folder / "log.txt").read_text()
    assert camera_lines(done.calibration, done.folder) == [f"Camera      {done.calibration}"]


def test_a_delay_is_found_and_adopted(
    found: RunSummary, late_sweep: Path, sweep_camera: Camera, quick: None, tmp_path: Path
) -> None:
    assert found.calibration.startswith("colour-depth delay")
    assert found.calibration.endswith("found and applied")
    camera = read_camera(found.folder / "camera.yaml")
    assert camera.depth_time_offset_s == pytest.approx(sweep_camera.depth_time_offset_s, abs=0.003)
    assert camera.rolling_shutter_s == 0.0
    saved = read_run(found.folder)
    assert saved.camera == camera
    assert (
        len(Run(found.folder).frames.timestamps_s) == FRAMES
    )  # those tracked first are taken back
    out, known = tmp_path / "known", found.folder / "camera.yaml"
    run(replace(late_options(late_sweep, out), camera=known, calibrate="off"))
    for name in ("trajectory.txt", "map", "graph"):  # as a run that has known the camera
        assert (out / name).read_bytes() == (found.folder / name).read_bytes(), name


def test_depth_of_the_frame_before_is_noticed_by_its_edges_and_cured(
    late_sweep: Path, sweep_camera: Camera, quick: None, tmp_path: Path
) -> None:
    shift_s = 1 / 15.0
    sequence = with_depth_stamps(late_sweep, tmp_path / "shifted", shift_s)
    done = run(late_options(sequence, tmp_path / "run"))
    events = Run(done.folder).events
    first = next(event for event in events if event.kind is EventKind.CALIBRATION)
    assert "by edges of depth: found and applied" in first.text, first
    right = replace(sweep_camera, depth_time_offset_s=sweep_camera.depth_time_offset_s - shift_s)
    found = read_camera(done.folder / "camera.yaml")
    assert found.depth_time_offset_s == pytest.approx(right.depth_time_offset_s, abs=0.005)
    write_camera(tmp_path / "right.yaml", right)
    known = replace(late_options(sequence, tmp_path / "known"), camera=tmp_path / "right.yaml")
    assert ate_m(done) < 1.2 * ate_m(run(replace(known, calibrate="off")))


def test_a_delay_that_edges_showed_is_taken_back_if_the_motion_contradicts_it(
    late_sweep: Path,
    sweep_camera: Camera,
    quick: None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    def deceived(state: SelfCalibration, *rest: Any) -> SelfCalibration:
        camera = replace(state.camera, depth_time_offset_s=0.07)
        return replace(state, camera=camera, text="delay 70.0 ms by edges: found and applied")

    write_camera(tmp_path / "right.yaml", sweep_camera)
    options = replace(late_options(late_sweep, tmp_path / "off"), camera=tmp_path / "right.yaml")
    off = run(replace(options, calibrate="off"))
    monkeypatch.setattr("bmask_slam.offline.self_calibration.with_sure_delay", deceived)
    done = run(replace(options, out=tmp_path / "run"))
    assert done.calibration == "delay 70.0 ms by edges: the motion contradicts it"
    assert not (done.folder / "camera.yaml").exists()
    for name in ("trajectory.txt", "map", "graph"):
        assert (done.folder / name).read_bytes() == (off.folder / name).read_bytes(), name


def ate_m(done: RunSummary) -> float:
    """Of a run."""
    return float(next(row["value"] for row in done.rows if row["name"] == "ate_rmse"))


def test_the_map_of_such_a_run_is_continued_with_its_camera(
    found: RunSummary, late_sweep: Path, tmp_path: Path
) -> None:
    gone_on = RunOptions(late_sweep, CONFIG, out=tmp_path / "on", map=found.folder, quiet=True)
    with pytest.raises(InputError, match="can only be continued with its own camera"):
        run(dataclasses.replace(gone_on, calibrate="off"))
    later = inherited_calibration(gone_on, runner.open_sequence(late_sweep))
    assert later.camera == read_camera(found.folder / "camera.yaml")


def test_a_run_that_continues_a_map_looks_again_and_the_map_follows(
    late_sweep: Path, sweep_camera: Camera, quick: None, tmp_path: Path
) -> None:
    """Here that was too short to be looked at. The stamps of both begin with the same ones."""
    config = resolve(SystemConfig, None, ("semantics.segmenter.name=none",))
    options = replace(late_options(late_sweep, tmp_path / "first"), config=config)
    first = run(replace(options, max_frames=30))
    options = replace(options, out=tmp_path / "on", map=first.folder, max_frames=None)
    done = run(options)
    assert done.calibration.endswith("found and applied")
    camera = read_camera(done.folder / "camera.yaml")
    assert camera.depth_time_offset_s == pytest.approx(sweep_camera.depth_time_offset_s, abs=0.003)
    assert read_run(done.folder).camera == camera
    alone = run(replace(options, out=tmp_path / "alone", map=None))
    assert ate_m(done) < 1.25 * ate_m(alone)  # 0.7 to 1.1 with other grids of keypoints


def test_few_frames_that_continue_a_map_do_not_change_its_camera(
    late_sweep: Path, sweep_camera: Camera, monkeypatch: pytest.MonkeyPatch
) -> None:
    third = replace(sweep_camera, depth_time_offset_s=sweep_camera.depth_time_offset_s / 3)
    sequence, system = open_sequence(late_sweep, camera=third), SlamSystem(third, CONFIG)
    for frame in sequence.frames(0, FRAMES - 1):
        system.process(frame)
    inherited = SelfCalibration(read_camera(late_sweep / "camera.yaml"), third, "a third")
    calibrator = SelfCalibrator(inherited, "auto")
    monkeypatch.setattr(calibrator, "_estimate", lambda *_: pytest.fail("it looked"))
    assert not calibrator.look_back(system, sequence)


def test_a_map_that_is_continued_follows_a_bend_of_depth(
    late_sweep: Path, sweep_camera: Camera
) -> None:
    given = sweep_camera
    bent = replace(given, depth_distortion=(0.02, -0.01, 0.005, 0.0, 0.03))
    tracked, system = SlamSystem(given, CONFIG), SlamSystem(given, CONFIG)
    for frame in open_sequence(late_sweep, camera=given).frames(0, 30):
        tracked.process(frame)
    state = tracked.state()
    system.restore(state, Path("map"))
    use_own_camera(system, state, bent)
    assert system.camera == system.mapper.camera == bent
    keyframes = tracked.mapper.world.keyframes
    assert len(keyframes) > 2
    for number, before in keyframes.items():
        after = system.mapper.world.keyframes[number].features
        seen = before.features.image_pixels
        expected = 1 / before.features.depth_m - bent.depth_bend(seen)
        np.testing.assert_allclose(1 / after.depth_m, expected, atol=1e-9)
    motions, path = recorded_motions(state), tracked.trajectory()
    for number, keyframe in keyframes.items():
        twist = twists_at(path, np.array([keyframe.timestamp_s]))[0]
        np.testing.assert_allclose(motions[number].twist, twist, atol=1e-9)
    assert np.linalg.norm(motions[max(motions)].twist) > 0.1


@pytest.mark.parametrize("number", KILLED)
def test_killed_before_and_after_the_adoption_and_resumed(
    number: int, found: RunSummary, quick: None
) -> None:
    killed = found.folder.with_name(f"killed-{number}")
    resumed = resume(killed, {"quiet": True})
    assert resumed is not None and resumed.calibration == found.calibration
    for name in ("trajectory.txt", "camera.yaml", "map", "graph", "events.csv"):
        assert (killed / name).read_bytes() == (found.folder / name).read_bytes(), name


def test_report_and_off_change_nothing(late_sweep: Path, quick: None, tmp_path: Path) -> None:
    options = RunOptions(late_sweep, CONFIG, quiet=True, max_frames=FRAMES)
    reported = run(dataclasses.replace(options, out=tmp_path / "r", calibrate="report"))
    off = run(dataclasses.replace(options, out=tmp_path / "o", calibrate="off"))
    assert reported.calibration.endswith("found, not applied") and off.calibration == ""
    assert not (tmp_path / "r" / "camera.yaml").exists()
    trajectories = [(tmp_path / name / "trajectory.txt").read_bytes() for name in "ro"]
    assert trajectories[0] == trajectories[1]
    with pytest.raises(InputError, match="--calibrate on: is not one of auto, report, off"):
        dataclasses.replace(options, calibrate="on")


def test_rows_that_are_read_upwards_are_noticed_and_used(
    turned_sweep: Path, quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where images were turned by 180 degrees; also after a kill behind the new beginning."""
    write, out, killed = checkpoint.write_checkpoint, tmp_path / "whole", tmp_path / "killed"

    def copied(path: Path, content: checkpoint.Checkpoint) -> None:
        write(path, content)
        if content.calibration.rows and content.counters.frames == 40:
            shutil.copytree(out, killed)

    monkeypatch.setattr("bmask_slam.offline.checkpoint.write_checkpoint", copied)
    found = run(late_options(turned_sweep, out))
    monkeypatch.undo()
    assert found.calibration.startswith("rows are read from the bottom up")
    assert read_camera(out / "camera.yaml").rolling_shutter_s == -0.02
    first = Run(out).events[0]
    assert first.kind is EventKind.CALIBRATION and "from the bottom up" in first.text
    with short_ends():
        resumed = resume(killed, {"quiet": True})
    assert resumed is not None and resumed.calibration == found.calibration
    for name in ("trajectory.txt", "camera.yaml", "map", "graph", "events.csv"):
        assert (killed / name).read_bytes() == (out / name).read_bytes(), name


def test_rows_that_are_read_upwards_are_only_reported_if_asked(
    turned_sweep: Path, quick: None, tmp_path: Path
) -> None:
    options = replace(late_options(turned_sweep, tmp_path / "r"), calibrate="report")
    assert run(options).calibration == (
        "rows are read from the bottom up, as in images turned by 180 degrees: found, not applied"
    )
    assert not (tmp_path / "r" / "camera.yaml").exists()


@pytest.mark.parametrize(
    ("place", "change_ms", "sigma_ms", "differs"),
    [
        (TIME, 20, 1, True), (TIME, -14, 2, True), (TIME, 2, 1, False), (TIME, 20, 6, False),
        (TIME, 60, 1, True), (TIME, -60, 5.5, True), (TIME, -60, 6.5, False),
        (TIME, 120, 1, False), (TIME, 101, 1, True),
        (SHUTTER, 20, 1, True), (SHUTTER, 60, 1, False), (SHUTTER, 36.5, 1.5, True),
    ],
)  # fmt: skip
def test_only_observable_parameters_are_changed(
    place: int, change_ms: float, sigma_ms: float, differs: bool
) -> None:
    found = np.where(np.arange(18) == place, 1e-3 * change_ms, 0.0)
    estimate = Estimate(
        np.zeros(18),
        found,
        np.full(18, 1e-3 * sigma_ms),
        None,  # type: ignore[arg-type]
    )
    config = SelfCalibrationConfig()
    assert estimate.differs(place, config) is differs
    assert not estimate.differs(TIME + SHUTTER - place, config)


@pytest.mark.parametrize(
    ("halves_ms", "agrees"),
    [((-19.0, -21.0), True), ((-12.0, -24.0), True), ((-9.0, -21.0), False), ((-20, 20), False)],
)
def test_both_halves_have_to_find_what_is_adopted(
    halves_ms: tuple[float, float], agrees: bool
) -> None:
    """Of -20 +- 1 ms found for a camera without delay, halves with sigmas of 1 ms."""
    found = np.where(np.arange(18) == TIME, -0.020, 0.0)
    estimate = Estimate(
        np.zeros(18),
        found,
        np.full(18, 0.001),
        None,  # type: ignore[arg-type]
    )
    calibrations = np.zeros((2, 18))
    calibrations[:, TIME] = 1e-3 * np.array(halves_ms)
    halves = CrossValidation(calibrations, np.full((2, 18), 0.001), np.zeros(4))
    assert estimate.agrees(TIME, halves, SelfCalibrationConfig()) is agrees


@pytest.mark.parametrize(
    ("gains", "asked", "adopted"),
    [((3.0,), 1, True), ((-1.0, 3.0), 2, True), ((1.0, 1.0), 2, False)],
)
def test_every_second_keyframe_is_asked_where_halves_in_time_prove_nothing(
    monkeypatch: pytest.MonkeyPatch, gains: tuple[float, ...], asked: int, adopted: bool
) -> None:
    """Of 26 +- 0.5 ms found for a camera without readout time; gains in standard errors."""
    calls = prove(monkeypatch, *gains)
    sure = surely_other(_times(readout_ms=26.0), SelfCalibrationConfig())
    assert calls == [False, True][:asked] and sure == ([SHUTTER] if adopted else [])


def prove(monkeypatch: pytest.MonkeyPatch, *gains_sigmas: float) -> list[bool]:
    """Halves agree with every estimate, and gain so much in each way. Returns the ways asked."""
    asked: list[bool] = []

    def proof(problem: Estimate, judged: tuple[int, ...], alternately: bool) -> CrossValidation:
        assert judged == FREE
        asked.append(alternately)
        gain = gains_sigmas[len(asked) - 1]
        return CrossValidation(
            np.zeros((2, 18)), np.full((2, 18), 0.1), gain + np.array([-1.0, 1.0])
        )

    monkeypatch.setattr("bmask_slam.calibration.adoption.cross_validate", proof)
    return asked


def _times(readout_ms: float, delay_ms: float = 0.0) -> Estimate:
    """An estimate, with sigmas of .5 ms, of a camera given without readout time and delay."""
    found, sigmas = np.zeros(18), np.zeros(18)
    found[[SHUTTER, TIME]] = 1e-3 * readout_ms, 1e-3 * delay_ms
    sigmas[[SHUTTER, TIME]] = 0.0005
    return Estimate(np.zeros(18), found, sigmas, None)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("readout_ms", "delay_ms", "gain", "then_s"),
    [
        (21.4, 0.3, 3.0, (0.020, 0.0)),  # as before, within its bounds
        (25.0, 0.3, 3.0, (0.025, 0.0)),  # another value of what was adopted
        (20.9, -15.0, 3.0, (0.0209, -0.015)),  # the delay too
        (25.0, -15.0, 1.0, (0.020, 0.0)),  # not proved
    ],
)
def test_the_last_look_replaces_what_was_adopted(
    monkeypatch: pytest.MonkeyPatch,
    readout_ms: float,
    delay_ms: float,
    gain: float,
    then_s: tuple[float, float],
) -> None:
    """Of a camera for which 20 ms were adopted at the first look."""
    prove(monkeypatch, gain, gain)
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    first = replace(camera, rolling_shutter_s=0.020)
    before = SelfCalibration(camera, first, "20 ms: found and applied", settled=True)
    after = judged(before, _times(readout_ms, delay_ms), "auto", SelfCalibrationConfig())
    assert (after.camera.rolling_shutter_s, after.camera.depth_time_offset_s) == then_s
    assert after.given == camera
    if after.camera == first:
        assert after == before


@pytest.mark.parametrize(("sigma", "taken"), [(0.001, True), (0.0018, False)])
def test_a_much_surer_bend_takes_the_place_of_one_that_it_does_not_contradict(
    monkeypatch: pytest.MonkeyPatch, sigma: float, taken: bool
) -> None:
    """0.020 / m in xx were adopted, known to 0.002; then 0.022 are found."""
    prove(monkeypatch, 3.0, 3.0)
    config, camera = SelfCalibrationConfig(), Camera(640, 480, 500.0, 500.0, 320.0, 240.0)

    def bent(found: float, sigma: float) -> Estimate:
        values = np.where(np.arange(18) == BENDS[2], found, 0.0)
        sigmas = np.where(np.isin(np.arange(18), BENDS), sigma, 0.0)
        return Estimate(np.zeros(18), values, sigmas, None)  # type: ignore[arg-type]

    first = judged(SelfCalibration(camera, camera), bent(0.020, 0.002), "auto", config)
    assert first.camera.depth_distortion[2] == 0.020
    last = bent(0.022, sigma)
    assert not last.contradicts(first.camera, config)
    after = judged(first, last, "auto", config)
    assert after.camera.depth_distortion[2] == (0.022 if taken else 0.020)
    assert after == first or after.bend_sigma < first.bend_sigma


def _gone() -> dict[int, KeyframeMotion]:
    raise InputError("runs/first/map: there is no saved map here")


@pytest.mark.parametrize("parallel", [False, True])
def test_after_the_last_frame_keyframes_get_the_depth_of_the_camera_found(
    late_sweep: Path, sweep_camera: Camera, parallel: bool
) -> None:
    """A run that has adopted a third of the delay looks back; no frame is tracked again."""
    given, delay_s = read_camera(late_sweep / "camera.yaml"), sweep_camera.depth_time_offset_s
    third = replace(given, depth_time_offset_s=delay_s / 3)
    sequence, right = open_sequence(late_sweep, camera=third), open_sequence(late_sweep)
    right = right.with_camera(sweep_camera)
    with closing(ParallelSystems(CONFIG.semantics.segmenter, late_sweep, Upright())) as systems:
        system = systems(third, DETAILED) if parallel else SlamSystem(third, DETAILED)
        for frame in sequence.frames(0, FRAMES):
            system.process(frame)
        before_m = _depth_error_m(system, right)
        state = SelfCalibration(given, third, "a third", settled=True)
        calibrator = SelfCalibrator(state, "auto")
        assert not SelfCalibrator(state, "off").look_back(system, sequence)
        assert not calibrator.look_back(system, sequence, _gone) and calibrator.state is state
        assert calibrator.look_back(system, sequence)
        assert not calibrator.look_back(system, sequence.with_camera(system.camera))
        text = system.events.take()[-1].text
        system.finish()
    camera = calibrator.state.camera
    assert system.mapper.camera == system.camera == camera
    assert camera.depth_time_offset_s == pytest.approx(delay_s, abs=0.003)
    assert text == calibrator.state.text and "colour-depth delay" in text
    assert _depth_error_m(system, right) < 0.5 * before_m


def test_a_run_keeps_the_camera_that_its_last_look_finds(
    late_sweep: Path,
    sweep_camera: Camera,
    quick: None,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    """Its first look adopts a third of the delay."""
    third_s = sweep_camera.depth_time_offset_s / 3

    def first(state: SelfCalibration, *rest: Any) -> SelfCalibration:
        if state.adopted:
            return judged(state, *rest)
        camera = replace(state.given, depth_time_offset_s=third_s)
        return replace(state, camera=camera, text="a third: found and applied", settled=True)

    monkeypatch.setattr("bmask_slam.offline.self_calibration.judged", first)
    summary = run(replace(late_options(late_sweep, tmp_path / "run"), checkpoint_every=None))
    camera = read_camera(summary.folder / "camera.yaml")
    assert camera.depth_time_offset_s == pytest.approx(sweep_camera.depth_time_offset_s, abs=0.003)
    assert read_run(summary.folder).camera == camera
    texts = [e.text for e in Run(summary.folder).events if e.kind is EventKind.CALIBRATION]
    assert texts == ["a third: found and applied", summary.calibration]


def test_a_last_look_that_shows_the_other_order_of_rows_changes_nothing_else(
    turned_sweep: Path,
) -> None:
    """What it finds of other parameters means nothing then."""
    given = read_camera(turned_sweep / "camera.yaml")
    adopted = replace(given, depth_time_offset_s=0.002)
    sequence, system = open_sequence(turned_sweep, camera=adopted), SlamSystem(adopted, CONFIG)
    for frame in sequence.frames(0, FRAMES):
        system.process(frame)
    calibrator = SelfCalibrator(SelfCalibration(given, adopted, "x", settled=True), "auto")
    assert not calibrator.look_back(system, sequence)
    assert calibrator.state.camera == system.camera == adopted
    text = system.events.take()[-1].text
    assert text.startswith("rows are read from the bottom up") and text.endswith("not applied")


def _depth_error_m(system: SlamSystem, right: Sequence) -> float:
    """Root mean square, of points that the graph observes, against frames of the right camera."""
    errors = []
    for keyframe in system.mapper.world.keyframes.values():
        index = int(np.argmin(np.abs(right.timestamps_s - keyframe.timestamp_s)))
        exact = system.prepare(right.load(index))
        n = len(exact.depth_m)  # what optical flow found comes behind
        observed = keyframe.landmark_ids[:n] >= 0
        errors.append((keyframe.features.depth_m[:n] - exact.depth_m)[observed])
    together = np.concatenate(errors)
    return float(np.sqrt(np.nanmean(together**2)))


@pytest.mark.parametrize(
    ("halves", "agrees"),
    [((0.012, 0.018), True), ((0.006, 0.015), False), ((0.015, -0.015), False)],
)
def test_a_bend_of_depth_is_compared_over_the_image(
    halves: tuple[float, float], agrees: bool
) -> None:
    """Of 0.015 / m in xx found for a camera without, by halves of which one has it in yy."""
    xx, yy = BENDS[2], BENDS[4]
    before, found = np.zeros(18), np.zeros(18)
    found[xx] = 0.015
    estimate = Estimate(before, found, np.full(18, 0.0005), None)  # type: ignore[arg-type]
    config = SelfCalibrationConfig()
    assert estimate.differs(xx, config) and not estimate.differs(yy, config)
    calibrations = np.zeros((2, 18))
    calibrations[:, xx] = halves
    sides = CrossValidation(calibrations, np.full((2, 18), 0.0005), np.zeros(4))
    assert estimate.agrees(xx, sides, config) is agrees
    assert "depth bent by up to 15 ± 2 mm at 1 m: said" in format_found(estimate, FREE, "said")


def test_what_is_found_can_be_kept_in_a_checkpoint() -> None:
    """Of three parameters that are looked for, two show."""
    sigmas = np.where(np.isin(np.arange(18), FREE), 0.0005, 0.0)
    sigmas[SHUTTER] = 0.1
    estimate = Estimate(np.zeros(18), np.zeros(18), sigmas, None)  # type: ignore[arg-type]
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    state = judged(SelfCalibration(camera, camera), estimate, "auto", SelfCalibrationConfig())
    assert json.dumps([state.settled, state.looks, state.text]).startswith("[false, 1, ")


@pytest.mark.parametrize(
    ("delay_ms", "bend", "mode", "last"),
    [
        (-15.0, 0.01, "auto", True),
        (-15.0, 0.0, "auto", False),  # the bend is not known
        (0.0, 0.01, "auto", False),  # the delay is another one, which is not proved
        (-15.0, 0.01, "report", False),  # there is no look at the end
    ],
)
def test_a_camera_found_before_is_looked_at_again_only_at_the_end(
    monkeypatch: pytest.MonkeyPatch, delay_ms: float, bend: float, mode: str, last: bool
) -> None:
    """A delay shows, -15 ms, and the bend does not."""
    prove(monkeypatch, 1.0, 1.0)
    before = np.zeros(18)
    before[TIME], before[BENDS[2]] = delay_ms / 1e3, bend
    found, sigmas = np.where(np.arange(18) == TIME, -0.015, 0.0), np.zeros(18)
    sigmas[TIME], sigmas[BENDS[2]] = 0.0005, 0.1
    estimate = Estimate(before, found, sigmas, None)  # type: ignore[arg-type]
    camera, config = Camera(640, 480, 500.0, 500.0, 320.0, 240.0), SelfCalibrationConfig()
    state = judged(SelfCalibration(camera, camera), estimate, mode, config)
    assert (state.looks, state.settled) == (config.stretches if last else 1, False)
    assert SelfCalibrator(state, mode).finished is last


def test_an_unsure_bend_is_not_observable() -> None:
    """Coefficients may be less sure than the surface that they make together, but not much."""
    found = np.where(np.isin(np.arange(18), BENDS), 0.05, 0.0)
    for sigma, shows in ((0.003, True), (0.006, False)):
        estimate = Estimate(np.zeros(18), found, np.full(18, sigma), None)  # type: ignore[arg-type]
        assert estimate.shows(BENDS[0], SelfCalibrationConfig()) is shows


def test_what_is_held_is_neither_changed_nor_told() -> None:
    sigmas = np.where(np.isin(np.arange(18), FREE), 0.0005, 0.0)
    sigmas[SHUTTER] = 0.0
    estimate = Estimate(np.zeros(18), np.zeros(18), sigmas, None)  # type: ignore[arg-type]
    config = SelfCalibrationConfig()
    assert not estimate.shows(SHUTTER, config) and not estimate.differs(SHUTTER, config)
    assert format_found(estimate, FREE, "said").startswith("colour-depth delay")


@pytest.mark.parametrize(
    ("readout_s", "k1", "held", "lens"), [(0.0, 0.1, False, False), (0.026, 0.0, True, True)]
)
def test_a_known_readout_is_held_and_an_unknown_lens_estimated_along(
    readout_s: float, k1: float, held: bool, lens: bool
) -> None:
    distortion = (k1, 0.0, 0.0, 0.0, 0.0)
    camera = Camera(
        640, 480, 500.0, 500.0, 320.0, 240.0, distortion=distortion, rolling_shutter_s=readout_s
    )
    sigmas = estimated_priors(camera, FREE)
    assert bool(sigmas[SHUTTER] == 0) is held
    assert (sigmas[LENS] > 0).tolist() == [lens, lens, False, False, False]
    assert (sigmas[list(BENDS)] > 0).all() and sigmas[TIME] > 0


def test_a_camera_takes_over_the_whole_bend() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, rolling_shutter_s=0.01)
    values = np.arange(18) / 1000.0
    adopted = camera_with(camera, values, list(BENDS))
    assert adopted == replace(camera, depth_distortion=(0.013, 0.014, 0.015, 0.016, 0.017))


def test_no_readout_is_longer_than_a_frame() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    values = np.where(np.arange(18) == SHUTTER, 0.0365, 0.0)
    assert camera_with(camera, values, [SHUTTER]).rolling_shutter_s == 0.035
    sure = Estimate(np.zeros(18), values, np.full(18, 0.001), None)  # type: ignore[arg-type]
    text = "rolling shutter 36.5 ± 2.0 ms (at most 35 are used): said"
    assert format_found(sure, (SHUTTER,), "said") == text


@pytest.mark.parametrize(
    ("looks", "frames", "last", "due"),
    [
        (0, 105, False, True), (0, 104, False, False), (0, 100, True, True), (0, 89, True, False),
        (1, 210, False, True), (1, 190, True, False), (1, 200, True, True), (2, 420, False, True),
        (3, 840, False, True), (4, 1680, False, False), (4, 1200, True, False),
    ],
)  # fmt: skip
def test_when_it_looks(looks: int, frames: int, last: bool, due: bool) -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    state = SelfCalibration(camera, camera, looks=looks)
    assert SelfCalibrator(state, "auto").is_due(frames, last) is due
    assert not SelfCalibrator(state, "off").is_due(frames, last)
    assert not SelfCalibrator(replace(state, settled=True), "auto").is_due(frames, last)


def test_masks_are_kept_while_the_run_may_begin_anew() -> None:
    class Counting(NoSegmenter):
        labels, calls = label_set(("cup",)), 0

        def segment(self, image: Image, name: str) -> list[Instance]:
            self.calls += 1
            mask = np.zeros(image.shape[:2], bool)
            mask[3, 4:9] = True
            found = [Instance(mask, mask_box(mask), 1, certain(1, 2), 1.0, 0.5)]
            return Segmented(found, None, "left")

    inner, image = Counting(), np.zeros((11, 13, 3), np.uint8)
    memory = MaskMemory()
    masks = RememberingSegmenter(inner, memory)
    first, again = masks.segment(image, "a.png"), masks.segment(image, "a.png")
    assert inner.calls == 1
    np.testing.assert_array_equal(first[0].mask, again[0].mask)
    assert again[0].mask_score == 0.5 and again[0].label == 1
    assert up_of(again) == "left"
    assert memory._found is not None
    packed = memory._found["a.png"][0]
    assert all(i.mask.base is None and i.mask.size == 0 for i, _ in packed)  # keeps no whole mask
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    SelfCalibrator(SelfCalibration(camera, camera, settled=True), "auto", memory)
    masks.segment(image, "a.png")
    assert inner.calls == 2


@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("fx", "fx"),
        ("depth offset", "depth_offset_m"),
        ("depth offset mm", "depth_offset_m"),
        ("depth-scale", "depth_factor"),
        ("rolling_shutter", "rolling_shutter_s"),
        ("Time offset ms", "time_offset_s"),
        ("depth_time_offset", "time_offset_s"),
        ("focal", None),
        ("depth_uv", "depth_uv"),
        ("depth bend uv", "depth_uv"),
    ],
)
def test_parameters_have_the_names_of_table_and_file(name: str, parameter: str | None) -> None:
    assert parameters_named(name) == ([parameter] if parameter else [])


def test_the_distortion_of_depth_is_named_as_a_whole() -> None:
    assert parameters_named("depth_distortion") == list(PARAMETERS[BEND])


def test_every_parameter_has_its_own_name() -> None:
    assert [parameters_named(name) for name in PARAMETERS] == [[name] for name in PARAMETERS]


def test_a_found_camera_is_adopted() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert not SelfCalibration(camera, camera).adopted
    other = dataclasses.replace(camera, rolling_shutter_s=0.02)
    assert SelfCalibration(camera, other).adopted


def test_a_run_that_begins_anew_frees_the_system_of_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A whole map, and its graph, would else be kept until the end."""
    systems: list[weakref.ref[FakeSystem]] = []

    def make(camera: Camera, config: SystemConfig) -> FakeSystem:
        system = FakeSystem(camera, config)
        system.itself = system  # as parts of a system know each other
        systems.append(weakref.ref(system))
        return system

    alive: list[int] = []

    def process(run: frame_loop.ActiveRun) -> bool:
        alive.append(sum(system() is not None for system in systems))
        return len(alive) < 3

    folder = make_sequence(tmp_path / "seq")
    monkeypatch.setattr(runner, "process_frames", process)
    monkeypatch.setattr(runner, "finish_run", lambda run: run)
    run(RunOptions(folder, out=tmp_path / "out", quiet=True), make)
    assert alive == [1, 1, 1]
    assert len(systems) == 3


def test_a_run_that_begins_anew_opens_its_recording_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A bag would be read from its beginning to its end for the stamps."""
    opened: list[Path] = []

    def counted(path: Path, camera: Camera | None) -> Recording:
        opened.append(path)
        return open_recording(path, camera)

    monkeypatch.setattr("bmask_slam.sequences.sequence.open_recording", counted)
    again = iter([True, True, False])
    monkeypatch.setattr(runner, "process_frames", lambda run: next(again))
    monkeypatch.setattr(runner, "finish_run", lambda run: run)
    folder = make_sequence(tmp_path / "seq")
    run(RunOptions(folder, out=tmp_path / "out", quiet=True), FakeSystem)
    assert opened == [folder]
