"""Faults put into a camera, its depth or its stamps, and what a run says of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from shifted_stamps import with_depth_stamps

from bmask_slam.calibration import camera_check
from bmask_slam.calibration.adoption import SelfCalibration
from bmask_slam.calibration.camera_check import (
    CameraCheck,
    check_camera,
    depth_warning,
)
from bmask_slam.calibration.edge_delay import delay_warning, sure_registration, with_sure_delay
from bmask_slam.calibration.edge_scores import correlation, edge_scores, edges_of
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import plot
from bmask_slam.graph.calibration.focal_check import FocalCheck
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import part
from bmask_slam.offline.runner import RunOptions, RunSummary, run
from bmask_slam.run_folder.map_file import read_map, read_run
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.map_state import world_of

CONFIG = resolve(
    SystemConfig, None, ("semantics.segmenter.name=none", "features.max_keypoints=400")
)
FRAMES, FPS = 70, 15.0


@pytest.fixture(scope="module", autouse=True)
def quick_plots() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        yield


@pytest.fixture(scope="module")
def right(
    late_sweep: Path, sweep_camera: Camera, tmp_path_factory: pytest.TempPathFactory
) -> RunSummary:
    return _run_with(sweep_camera, late_sweep, tmp_path_factory.mktemp("check"))


def _run_with(camera: Camera, sequence: Path, folder: Path) -> RunSummary:
    write_camera(folder / "camera.yaml", camera)
    options = RunOptions(sequence, CONFIG, camera=folder / "camera.yaml", max_frames=FRAMES)
    return run(dataclasses.replace(options, out=folder / "run", quiet=True, calibrate="off"))


def _with_depth(sequence: Path, folder: Path, shift: tuple[int, int] = (0, 0), scale: float = 1.0):
    """A copy whose depth images are moved by (u, v) pixels, and larger by a scale."""
    folder.mkdir()
    for name in ("rgb", "rgb.txt", "depth.txt", "camera.yaml"):
        (folder / name).symlink_to(sequence / name)
    (folder / "depth").mkdir()
    for path in (sequence / "depth").iterdir():
        depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        height, width = depth.shape
        about = (1 - scale) * np.array([width - 1, height - 1]) / 2
        M = np.array([[scale, 0, about[0] + shift[0]], [0, scale, about[1] + shift[1]]])
        moved = cv2.warpAffine(depth, M, (width, height), flags=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / "depth" / path.name), moved)
    return folder


def _checked(right: RunSummary, sequence: Path, camera: Camera | None = None) -> CameraCheck:
    """What the right camera's run says with the images of another folder."""
    saved = read_run(right.folder)
    camera = camera or saved.camera
    return check_camera(
        dataclasses.replace(saved, camera=camera), open_sequence(sequence, camera=camera)
    )


def test_a_right_camera_gets_no_warning_and_figures_in_the_metrics(right: RunSummary) -> None:
    assert right.warnings == ()
    rows = {row["name"]: row["value"] for row in right.rows}
    assert rows["camera_warnings"] == 0
    assert abs(rows["camera_focal_change"]) < 0.5
    assert abs(rows["camera_depth_shift_u"]) < 2 and abs(rows["camera_depth_delay_ms"]) < 8
    log = (right.folder / "log.txt").read_text()
    assert "camera: focal length" in log and "depth scale: not observable" in log


@pytest.mark.parametrize("share", [0.04, -0.04])
def test_a_wrong_focal_length_is_named(
    late_sweep: Path, sweep_camera: Camera, tmp_path: Path, share: float
) -> None:
    fx, fy = sweep_camera.fx * (1 + share), sweep_camera.fy * (1 + share)
    wrong = dataclasses.replace(sweep_camera, fx=fx, fy=fy)
    (warning,) = _run_with(wrong, late_sweep, tmp_path).warnings
    assert warning.startswith("focal length") and "bmask-slam calibrate" in warning
    assert (" % less than" if share > 0 else " % more than") in warning


@pytest.mark.parametrize(
    ("stored_share", "found", "warned"),
    [
        (0.024, (0.004, 0.002), False),
        (0.024, (0.022, 0.002), False),
        (0.017, (0.03, 0.002), True),
        (0.024, (0.03, 0.006), True),  # sure together
        (0.017, (0.03, 0.006), False),
        (0.024, (-0.03, 0.002), False),  # they contradict each other
    ],
)
def test_landmarks_that_are_found_again_decide_about_a_doubtful_focal_length(
    right: RunSummary,
    late_sweep: Path,
    monkeypatch: pytest.MonkeyPatch,
    stored_share: float,
    found: tuple[float, float],
    warned: bool,
) -> None:
    """They show all of an error, the matches of tracking two thirds: the limit is 2.25 %."""
    share, sigma = found
    stored = FocalCheck(stored_share, 0.003, (0.02, 0.02))
    answers = [stored, FocalCheck(share, sigma, (share, share))]
    monkeypatch.setattr(camera_check, "check_focal", lambda problem: answers.pop(0))
    state, camera = read_map(right.folder)
    run, sequence = read_run(right.folder), open_sequence(late_sweep, camera=camera)
    checked = check_camera(run, sequence, world_of(part(state, "mapper.world")))
    assert not answers and bool(checked.warnings) is warned
    rows = {row["name"]: row["value"] for row in checked.rows}
    assert rows["camera_focal_change"] == pytest.approx(100 * share)


def test_shifted_depth_is_named_with_the_shift_that_cures(
    late_sweep: Path, right: RunSummary, tmp_path: Path
) -> None:
    found = _checked(right, _with_depth(late_sweep, tmp_path / "shifted", shift=(8, -3)))
    (warning,) = (w for w in found.warnings if w.startswith("registration"))
    rows = {row["name"]: row["value"] for row in found.rows}
    assert rows["camera_depth_shift_u"] == pytest.approx(-8, abs=1)
    assert rows["camera_depth_shift_v"] == pytest.approx(3, abs=1)
    assert "register depth to colour" in warning


def test_depth_of_another_focal_length_is_named(
    late_sweep: Path, right: RunSummary, tmp_path: Path
) -> None:
    found = _checked(right, _with_depth(late_sweep, tmp_path / "larger", scale=1.12))
    assert any("scaled by 0.8" in w or "scaled by 0.9" in w for w in found.warnings), found


@pytest.mark.parametrize("frames", [1, -1])
def test_stamps_of_depth_that_are_wrong_are_named(
    late_sweep: Path, right: RunSummary, tmp_path: Path, frames: int
) -> None:
    shifted = with_depth_stamps(late_sweep, tmp_path, frames / FPS)
    (warning,) = (w for w in _checked(right, shifted).warnings if w.startswith("stamps"))
    assert ("ms earlier" if frames > 0 else "ms later") in warning


@pytest.mark.parametrize("late_s", [0.0, 1 / FPS])
def test_edges_warn_of_a_delay_and_give_one_that_is_sure(
    late_sweep: Path, right: RunSummary, tmp_path: Path, late_s: float
) -> None:
    saved = read_run(right.folder)
    camera, path = saved.camera, saved.trajectories["trajectory.txt"]
    shifted = with_depth_stamps(late_sweep, tmp_path, late_s)
    found = sure_registration(edge_scores(open_sequence(shifted, camera=camera), path))
    assert delay_warning(found, camera).startswith("stamps: depth images are") == bool(late_s)
    turned = dataclasses.replace(camera, rolling_shutter_s=0.02)
    before = SelfCalibration(
        camera, turned, text="rolling shutter 20.0 ± 1.0 ms: found and applied"
    )
    late = with_sure_delay(before, found, camera.depth_time_offset_s)
    assert (late is not None) == bool(late_s)
    if late is not None:
        right_s = camera.depth_time_offset_s - late_s
        assert late.camera.depth_time_offset_s == pytest.approx(right_s, abs=0.01)
        assert late.camera.rolling_shutter_s == 0.02 and late.text.startswith(before.text)


def test_depth_edges_are_where_the_surface_in_front_ends() -> None:
    depth_m = np.full((120, 160), 3.0)
    depth_m[30:90, 60:100] = 1.0
    depth_m[30:90, 52:60] = np.nan  # the shadow of what is in front
    rgb = np.full((120, 160, 3), 200, np.uint8)
    rgb[30:90, 60:100] = 50
    edges = edges_of(rgb, depth_m)
    assert set(np.flatnonzero(edges.depth[0][60])) == {59, 60, 99, 100}
    assert set(np.flatnonzero(edges.depth[1][:, 80])) == {29, 30, 89, 90}
    scores = correlation(edges, 1)
    middle = len(scores) // 2
    assert _best(scores) == pytest.approx((middle, middle), abs=1)
    moved = edges_of(np.roll(rgb, (2, 5), (0, 1)), depth_m)
    scores = correlation(moved, 1)
    assert _best(scores) == pytest.approx((middle + 2, middle + 5), abs=1)


def _best(scores) -> tuple[int, ...]:
    return tuple(int(i) for i in np.unravel_index(scores.argmax(), scores.shape))


@pytest.mark.parametrize(
    ("depth_m", "text"),
    [
        (9000.0, "depth: 9000 m in the median, with depth_scale 5000; check depth_scale"),
        (0.009, "depth: 0.009 m in the median"),
        (2.0, ""),
        (np.nan, ""),
    ],
)
def test_a_wrong_unit_of_depth_is_told(depth_m: float, text: str) -> None:
    class Images(list[SimpleNamespace]):
        camera = Camera(6, 4, 5.0, 5.0, 3.0, 2.0)
        load = list.__getitem__

    frames = [SimpleNamespace(depth_m=np.full((4, 6), depth_m, np.float32)) for _ in range(3)]
    sequence: Any = Images(frames)
    found = depth_warning(sequence)
    assert found.startswith(text) and bool(found) == bool(text)


def test_depth_that_is_mostly_too_far_to_be_used_is_told() -> None:
    class Images(list[SimpleNamespace]):
        camera = Camera(6, 4, 5.0, 5.0, 3.0, 2.0)
        load = list.__getitem__

    sequence: Any = Images([SimpleNamespace(depth_m=np.full((4, 6), 9.0, np.float32))] * 3)
    assert depth_warning(sequence) == ""
    assert depth_warning(sequence, 10.0) == ""
    assert "1; most is beyond the 8 m that are used" in depth_warning(sequence, 8)


def test_a_broken_image_does_not_hide_a_wrong_unit_of_depth() -> None:
    class Images(list[SimpleNamespace]):
        camera = Camera(6, 4, 5.0, 5.0, 3.0, 2.0)

        def load(self, index: int) -> SimpleNamespace:
            if index == 1:
                raise InputError("1.png: broken")
            return self[index]

    frame = SimpleNamespace(depth_m=np.full((4, 6), 9000, np.float32))
    sequence: Any = Images([frame] * 3)
    assert depth_warning(sequence).startswith("depth: 9000 m in the median")
