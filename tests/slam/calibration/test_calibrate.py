"""``bmask-slam calibrate``: from a run folder and its images to the camera.yaml of the next run."""

from __future__ import annotations

import dataclasses
import re
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest
from calibration_run import camera_path, make_run, room_depth

from bmask_slam import cli
from bmask_slam.calibration.calibrate import CalibrateOptions, calibrate_run
from bmask_slam.calibration.report import format_calibration
from bmask_slam.features.keypoint_depth import smooth_value
from bmask_slam.graph.calibration.model import TIME
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.offline import calibration_rounds
from bmask_slam.offline.run_end import RunSummary
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.sequences.sequence import open_sequence

TRUTH = Camera(320, 240, 262.0, 260.0, 158.0, 121.0, depth_scale=5000.0, depth_offset_m=0.015)
WRONG = dataclasses.replace(
    TRUTH, fx=270.0, fy=268.0, cx=161.0, cy=118.0, depth_scale=5150.0, depth_offset_m=0.0
)
DELAY_S = 0.010


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return make_run(tmp_path_factory.mktemp("calibrate"), TRUTH, WRONG, DELAY_S)


def test_a_wrong_camera_and_delayed_depth_are_found(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    sequence, run = made
    out = tmp_path / "camera.yaml"
    options = CalibrateOptions(run, out, reference=sequence, anchor_sigma_m=0.002)
    done = calibrate_run(options)
    found = read_camera(out)
    assert found == done.camera
    assert found.fx == pytest.approx(TRUTH.fx, rel=0.003)
    assert found.fy == pytest.approx(TRUTH.fy, rel=0.003)
    assert (found.cx, found.cy) == pytest.approx((TRUTH.cx, TRUTH.cy), abs=0.5)
    assert found.depth_scale == pytest.approx(TRUTH.depth_scale, rel=0.003)
    assert found.depth_offset_m == pytest.approx(TRUTH.depth_offset_m, abs=0.003)
    assert found.depth_time_offset_s == pytest.approx(DELAY_S, abs=0.001)
    truth = [262, 260, 158, 121, 0, 0, 0, 0, 0, 1.03, 0.015, DELAY_S, 0, *(0,) * 5]
    error = done.result.calibration - truth
    second_order = np.where(np.arange(18) == TIME, 1e-4, 1e-9)  # in the 10 ms
    assert (np.abs(error) <= 3.5 * done.sigmas + second_order).all()
    assert "not observable" not in format_calibration(done)
    assert "reduced" not in format_calibration(done)
    of_reduced = dataclasses.replace(found, reduced_by=2)
    text = format_calibration(dataclasses.replace(done, camera=of_reduced))
    used, own = (f"{k * found.width}x{k * found.height}" for k in (1, 2))
    assert f"images reduced to {used}, the file of the recorded ones, {own}" in text


@pytest.mark.parametrize("known_s", [0.0, 0.020])
def test_a_rolling_shutter_is_found(tmp_path: Path, known_s: float) -> None:
    """From a run without rolling-shutter correction, and from one with it."""
    truth = dataclasses.replace(TRUTH, rolling_shutter_s=0.020)
    used = dataclasses.replace(WRONG, rolling_shutter_s=known_s)
    sequence, run = make_run(tmp_path, truth, used, DELAY_S)
    options = CalibrateOptions(run, reference=sequence, anchor_sigma_m=0.002)
    done = calibrate_run(options)
    found = read_camera(run / "camera.yaml")
    assert found.rolling_shutter_s == pytest.approx(0.020, abs=0.001)
    assert found.fx == pytest.approx(TRUTH.fx, rel=0.005)
    assert (found.cx, found.cy) == pytest.approx((TRUTH.cx, TRUTH.cy), abs=1.0)
    assert "rolling shutter ms" in format_calibration(done)


def test_without_an_anchor_the_scale_stays_and_is_reported_as_unobservable(
    made: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, run = made
    assert cli.main(["calibrate", str(run), "--fix", "k1", "--fix", "k2"]) == 0
    text = capsys.readouterr().out
    assert "The depth scale is not observable: images and depths fit a world of any size" in text
    assert "held fixed" in text
    found = read_camera(run / "camera.yaml")
    assert found.depth_scale == WRONG.depth_scale
    assert found.depth_time_offset_s == pytest.approx(DELAY_S, abs=0.001)
    assert cli.main(["calibrate", str(run)]) == 1
    assert "is there already" in capsys.readouterr().err


def test_a_known_distance_gives_the_scale(made: tuple[Path, Path], tmp_path: Path) -> None:
    _, run = made
    times_s = np.array([0.1, 1.5])
    distance_m = float(np.linalg.norm(np.diff(camera_path(times_s)[:, :3, 3], axis=0)))
    known = (0.1, 1.5, distance_m)
    done = calibrate_run(
        CalibrateOptions(run, tmp_path / "c.yaml", known_distance=known, anchor_sigma_m=1e-3)
    )
    assert done.camera.depth_scale == pytest.approx(TRUTH.depth_scale, rel=0.005)


def test_a_distance_that_says_little_of_the_scale_leaves_the_depth_offset(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    """It moved by as much as an uncertain scale asked for."""
    known = (0.1, 1.5, 0.5)
    loose = CalibrateOptions(made[1], tmp_path / "c.yaml", known_distance=known, anchor_sigma_m=0.1)
    done = calibrate_run(loose)
    text = format_calibration(done)
    assert done.camera.depth_offset_m == WRONG.depth_offset_m
    assert done.camera.depth_scale != WRONG.depth_scale
    assert "The depth offset keeps its value" in text
    assert re.search("depth scale: (not|only weakly) observable.* move farther", text)


def test_a_broken_depth_image_beside_a_keyframe_only_lacks_its_rate(
    made: tuple[Path, Path], tmp_path: Path
) -> None:
    sequence, run = made
    shutil.copytree(sequence, beside := tmp_path / "sequence")
    file = sorted((beside / "depth").iterdir())[3]  # three for each keyframe, the second is its own
    file.write_bytes(file.read_bytes()[:200])
    options = CalibrateOptions(run, tmp_path / "c.yaml", beside)
    assert calibrate_run(options).camera.depth_time_offset_s == pytest.approx(DELAY_S, abs=0.001)


def test_the_next_run_reads_what_was_written(made: tuple[Path, Path], tmp_path: Path) -> None:
    """Scale, offset and time: depth images are those at the stamps of the colour images."""
    sequence, _ = made
    right = dataclasses.replace(TRUTH, depth_time_offset_s=DELAY_S)
    write_camera(tmp_path / "camera.yaml", right, "a comment\nof two lines")
    assert read_camera(tmp_path / "camera.yaml") == right
    opened = open_sequence(sequence, camera=tmp_path / "camera.yaml")
    v, u = np.mgrid[:240, :320]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)

    def typical_error_m(index: int, camera: Camera) -> float:
        T = camera_path(opened.timestamps_s[[index]])[0]
        depth_m = open_sequence(sequence, camera=camera).load(index).depth_m
        assert np.isfinite(depth_m).mean() > 0.6  # missing where the surface changes
        apart_m = np.abs(depth_m - room_depth(T, TRUTH, pixels).reshape(240, 320))
        return float(np.nanmedian(apart_m))

    for index in (7, 22, 40):
        assert typical_error_m(index, right) < 0.0015
        assert typical_error_m(index, TRUTH) > 0.0025


# --- parts ----------------------------------------------------------------------------------------


def test_a_plane_is_fitted_between_pixels_and_an_edge_is_rejected() -> None:
    v, u = np.mgrid[:60, :80].astype(float)
    image = 0.5 + 0.002 * u - 0.001 * v
    pixels = np.array([[20.3, 30.7], [41.8, 12.2], [1.0, 1.0]])
    planes, rms, max_step = smooth_value(image, pixels, np.full(3, 0.0025))
    value = planes[:, 0]
    expected = 0.5 + 0.002 * pixels[:2, 0] - 0.001 * pixels[:2, 1]
    np.testing.assert_allclose(value[:2], expected, atol=1e-9)
    assert (rms[:2] < 1e-9).all() and np.isnan(value[2])  # most of its window is outside
    image[:, 40:] *= 0.8
    assert np.isnan(smooth_value(image, pixels, np.full(3, 0.0025))[0][1]).all()
    assert (max_step == 0.01).all()


def test_what_is_smooth_is_judged_by_the_noise_of_the_image() -> None:
    u = np.mgrid[:480, :640][1].astype(float)
    noise = np.random.default_rng(1).normal(size=u.shape)
    image = 0.5 + 1e-4 * u + np.where(u < 300, 0.0, 0.1) + 0.006 * noise
    pixels = np.column_stack([x.ravel() for x in np.mgrid[20:620:30, 20:460:40]]).astype(float)
    planes, _, max_step = smooth_value(image, pixels, np.full(len(pixels), 0.002))
    assert 3.5 * 0.006 < max_step[0] < 4.5 * 0.006
    at_edge = np.abs(pixels[:, 0] - 299.5) < 5
    assert np.isfinite(planes[~at_edge]).mean() > 0.9 and np.isnan(planes[at_edge]).all()


# --- bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fixed": ("focal",)}, "--fix focal: is no parameter"),
        ({"anchor_sigma_m": 0.0}, "--anchor-sigma 0.0: must be positive"),
        ({"anchor_sigma_m": np.inf}, "--anchor-sigma inf: must be positive"),
        ({"known_distance": (0.1, 99.0, 1.0)}, "--known-distance 0.1 99 1: give two different"),
        ({"known_distance": (np.nan, 0.3, 1.0)}, "--known-distance nan 0.3 1: give two different"),
        ({"known_distance": (0.1, 0.3, np.inf)}, "--known-distance 0.1 0.3 inf: give two"),
        ({"sequence": Path("/nowhere")}, "/nowhere: no such folder"),
        ({"run": Path("/nowhere")}, "/nowhere: no such folder; give the folder of a run"),
    ],
)
def test_impossible_options_are_refused(made, tmp_path, changes, words) -> None:
    with pytest.raises(InputError, match=words):
        calibrate_run(
            CalibrateOptions(**{"run": made[1], "out": tmp_path / "camera.yaml"} | changes)
        )
    assert not (tmp_path / "camera.yaml").exists()


def test_two_rounds_rerun_with_the_found_camera(
    late_sweep: Path, sweep_camera: Camera, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On rendered images, with focal lengths 3 % off; only the camera.yaml is left."""
    sequence, run, truth = late_sweep, tmp_path / "run", sweep_camera
    wrong = dataclasses.replace(truth, fx=truth.fx * 1.03, fy=truth.fy * 1.03)
    write_camera(tmp_path / "wrong.yaml", wrong)
    options = ["--camera", str(tmp_path / "wrong.yaml"), "--segmenter", "none", "--quiet"]
    options += ["--calibrate", "off", "--max-frames", "40", "--set", "features.max_keypoints=400"]
    assert cli.main(["run", str(sequence), *options, "--out", str(run)]) == 0
    before = sorted(path.name for path in run.iterdir())
    assert cli.main(["calibrate", str(run), "--reference", str(sequence), "--rounds", "0"]) == 1
    assert "--rounds 0: must be a whole number" in capsys.readouterr().err
    calibrate = ["calibrate", str(run), "--reference", str(sequence), "--quiet"]
    assert cli.main([*calibrate, "--out", str(tmp_path / "one.yaml")]) == 0
    assert cli.main([*calibrate, "--rounds", "2"]) == 0
    assert sorted(path.name for path in run.iterdir()) == sorted([*before, "camera.yaml"])
    text = (run / "camera.yaml").read_text()
    assert f"{wrong.fx:.2f}" in text.split("after")[1].splitlines()[1]  # before: the first run's
    found = [read_camera(path) for path in (tmp_path / "one.yaml", run / "camera.yaml")]
    assert found[0] != found[1]
    for camera in found:
        assert camera.fx == pytest.approx(truth.fx, rel=0.01)


def test_a_stop_in_a_later_round_ends_the_calibration(
    made: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The camera of a run that was cut off is none to write."""
    sequence, run = made
    stopped = RunSummary(Path("run-2"), [], 7, 0, signal.SIGINT)
    monkeypatch.setattr(calibration_rounds, "run", lambda options: stopped)
    options = CalibrateOptions(run, tmp_path / "camera.yaml", sequence=sequence)
    with pytest.raises(KeyboardInterrupt):
        calibration_rounds.calibrate_in_rounds(options, 2)
    assert list(tmp_path.iterdir()) == []


def test_the_images_of_another_recording_are_named(made: tuple[Path, Path], tmp_path: Path) -> None:
    sequence, run = made
    other = tmp_path / "other"
    shutil.copytree(sequence, other)
    for name in ("rgb.txt", "depth.txt"):
        rows = [line.split() for line in (sequence / name).read_text().splitlines()]
        later = [f"{float(row[0]) + 100} {row[1]}" for row in rows if row[0] != "#"]
        (other / name).write_text("\n".join(later) + "\n")
    options = CalibrateOptions(run, tmp_path / "camera.yaml", sequence=other)
    with pytest.raises(InputError, match=f"{other}: has no image of a keyframe of {run}"):
        calibrate_run(options)
