"""Self-calibration in a run: observability, adoption, resuming and continuing."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.calibration.adoption import (
    Estimate,
    SelfCalibration,
    SelfCalibrationConfig,
    next_start,
)
from bmask_slam.calibration.report import parameter_named
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.calibration.model import PARAMETERS, SHUTTER, TIME
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.offline import runner
from bmask_slam.offline.runner import RunOptions, resume, run
from bmask_slam.offline.self_calibration import SelfCalibrator
from bmask_slam.rendering.sequence import RenderConfig, render_sequence
from bmask_slam.run_folder.map_file import read_run
from bmask_slam.sequences import read_camera
from bmask_slam.system_config import SystemConfig

CONFIG = resolve(SystemConfig, None, ("semantics.segmenter.name=none",))
DELAY_S = 0.012


@pytest.fixture(scope="module")
def late_depth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rendered sequence with delayed depth images, without the delay in its camera."""
    folder = tmp_path_factory.mktemp("late") / "office"
    config = RenderConfig(
        "office", 100, fps=15.0, width=320, height=240, sweeping=True, depth_delay_ms=1e3 * DELAY_S
    )
    return render_sequence(config, folder)


def test_a_delay_is_found_adopted_and_kept_by_resume(late_depth: Path, tmp_path: Path) -> None:
    options = RunOptions(late_depth, CONFIG, quiet=True, checkpoint_every=60, calibrate="auto")
    whole = run(dataclasses.replace(options, out=tmp_path / "whole"))
    assert "colour-depth delay" in whole.calibration
    assert whole.calibration.endswith("found and applied")
    found = read_camera(tmp_path / "whole" / "camera.yaml")
    assert found.depth_time_offset_s == pytest.approx(DELAY_S, abs=0.0015)
    assert found.rolling_shutter_s == pytest.approx(0.0, abs=0.001)
    assert read_run(tmp_path / "whole").camera == found
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "bmask_slam.offline.frame_loop.RunFolder.complete", lambda folder: None
        )  # its last checkpoint stays
        run(dataclasses.replace(options, out=tmp_path / "again"))
    (tmp_path / "again" / "metrics.json").unlink()
    resumed = resume(tmp_path / "again", {"quiet": True})
    assert resumed is not None and resumed.calibration == whole.calibration
    for name in ("trajectory.txt", "camera.yaml"):
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    continued = dataclasses.replace(options, out=tmp_path / "on", map=tmp_path / "whole")
    with pytest.raises(InputError) as caught:  # the same stamps again
        run(dataclasses.replace(continued, calibrate="off"))
    assert "can only be continued with its own camera" in str(caught.value)
    later = runner.find_calibration(
        continued, runner.open_sequence(late_depth), runner.SlamSystem, runner.StopRequest()
    )
    assert later.camera == found


def test_report_and_off_change_nothing(late_depth: Path, tmp_path: Path) -> None:
    options = RunOptions(late_depth, CONFIG, quiet=True, max_frames=100)
    reported = run(dataclasses.replace(options, out=tmp_path / "r", calibrate="report"))
    off = run(dataclasses.replace(options, out=tmp_path / "o", calibrate="off"))
    assert reported.calibration.endswith("found, not applied") and off.calibration == ""
    assert not (tmp_path / "r" / "camera.yaml").exists()
    trajectories = [(tmp_path / name / "trajectory.txt").read_bytes() for name in "ro"]
    assert trajectories[0] == trajectories[1]
    with pytest.raises(InputError, match="--calibrate on: is not one of auto, report, off"):
        dataclasses.replace(options, calibrate="on")


@pytest.mark.parametrize(
    ("change_ms", "sigma_ms", "differs"),
    [(20.0, 1.0, True), (-14.0, 2.0, True), (2.0, 1.0, False), (20.0, 6.0, False), (60, 1, False)],
)
def test_only_observable_parameters_are_changed(
    change_ms: float, sigma_ms: float, differs: bool
) -> None:
    found = np.where(np.arange(13) == TIME, 1e-3 * change_ms, 0.0)
    estimate = Estimate(
        np.zeros(13),
        found,
        np.full(13, 1e-3 * sigma_ms),
        None,  # type: ignore[arg-type]
    )
    config = SelfCalibrationConfig()
    assert estimate.differs(TIME, config) is differs
    assert not estimate.differs(SHUTTER, config)


def test_a_short_sequence_is_not_calibrated(late_depth: Path) -> None:
    sequence = runner.open_sequence(late_depth)
    calibrator = SelfCalibrator(sequence, lambda _: sequence, range(40), runner.SlamSystem)
    found = calibrator.calibrate(runner.StopRequest(), quiet=True)
    assert found.camera == sequence.camera and not found.adopted


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
    ],
)
def test_parameters_have_the_names_of_table_and_file(name: str, parameter: str | None) -> None:
    assert parameter_named(name) == parameter


def test_every_parameter_has_its_own_name() -> None:
    assert [parameter_named(name) for name in PARAMETERS] == list(PARAMETERS)


def test_a_found_camera_is_adopted() -> None:
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert not SelfCalibration(camera, camera).adopted
    other = dataclasses.replace(camera, rolling_shutter_s=0.02)
    assert SelfCalibration(camera, other).adopted


def test_two_rounds_are_extrapolated() -> None:
    """A run with a camera error d finds a camera with a fraction of d as error."""
    truth, share = 0.026, 0.4

    def estimate(start: float) -> Estimate:
        before, found = np.zeros(13), np.zeros(13)
        before[SHUTTER], found[SHUTTER] = start, truth + share * (start - truth)
        return Estimate(before, found, np.full(13, 1e-4), None)  # type: ignore[arg-type]

    first = estimate(0.0)
    second = estimate(next_start([first])[SHUTTER])
    assert second.before[SHUTTER] == first.found[SHUTTER]
    third = next_start([first, second])
    assert third[SHUTTER] == pytest.approx(truth, abs=1e-9)
    assert third[TIME] == 0.0
    assert estimate(third[SHUTTER]).settled([SHUTTER]) and not second.settled([SHUTTER])
