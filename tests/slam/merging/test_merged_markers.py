"""Fiducial markers of runs that are merged: what both saw is one marker."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from synthetic_view import CAMERA, PLANE_Z_M, render_plane, sideways_path

from bmask_slam.config.configuration import dump
from bmask_slam.evaluation import plot
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.features.marker_detection import draw_marker
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    quaternion_from_rotation,
    se3_exp,
    se3_log,
    transform,
)
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.markers import CORNERS, FoundMarker, MarkersConfig
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.merging.merge import MergeOptions, merge_runs
from bmask_slam.run_folder import metrics
from bmask_slam.run_folder.folder import RunFolder
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.keyframe_decision import KeyframeConfig

SIZE_M = 0.2
MARKERS = MarkersConfig(enabled=True, size_m=SIZE_M)
FEATURES = FeatureConfig(max_keypoints=400)
OFTEN = KeyframeConfig(min_interval_frames=1, late_frames=2, late_shared=1.0)


def on_the_plane(x_m: float, y_m: float) -> Array:
    """T_plane_marker of a marker on the plane, which faces the camera."""
    return make_pose(np.diag([1.0, -1.0, -1.0]), np.array([x_m, y_m, PLANE_Z_M]))


PLACES = {4: on_the_plane(-1.0, 0.3), 9: on_the_plane(-2.6, -0.2), 2: on_the_plane(0.7, 0.1)}
"""The first is seen by both walks, the others by one each."""
WALKS = {
    "first": sideways_path(np.linspace(-1.7, -0.6, 8)),
    "second": [
        T @ se3_exp(np.array([0.0, 0.0, 0.3, 0.2, 0.1, 0.0]))
        for T in sideways_path(np.linspace(-1.4, -0.3, 8))
    ],
}


def view(T_plane_camera: Array, index: int, places: dict[int, Array]) -> Frame:
    """The plane with markers that hang on it, each with a white border."""
    frame = render_plane(T_plane_camera, index)
    gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
    for number, T_plane_marker in places.items():
        side = 400
        print_ = np.pad(draw_marker(MARKERS, number, side), side // 5, constant_values=255)
        edge = side / 5 - 0.5  # pixels' centres are at integers
        there = edge + np.array([[0, 0], [side, 0], [side, side], [0, side]])
        corners = transform(inverse(T_plane_camera) @ T_plane_marker, SIZE_M * CORNERS)
        if corners[:, 2].min() < 0.1:
            continue
        pixels = CAMERA.project(corners).astype(np.float32)
        H = cv2.getPerspectiveTransform(there.astype(np.float32), pixels)
        size = CAMERA.width, CAMERA.height
        seen = cv2.warpPerspective(print_, H, size, flags=cv2.INTER_AREA)
        mask = cv2.warpPerspective(np.full_like(print_, 255), H, size)
        gray = np.where(mask > 127, seen, gray)
    return replace(frame, rgb=cv2.cvtColor(gray, cv2.COLOR_GRAY2RGB))


def walk(
    folder: Path, name: str, config: MarkersConfig = MARKERS, places: dict[int, Array] = PLACES
) -> Path:
    """The folder of a run of a walk past markers."""
    sensors = SensorsConfig(markers=config)
    system = SlamSystem(CAMERA, SystemConfig(FEATURES, keyframes=OFTEN, sensors=sensors))
    with RunFolder(folder / name) as run:
        run.write_text("config.yaml", f"# bmask-slam 0, live\n{dump(system.config)}")
        for index, T in enumerate(WALKS[name]):
            run.write_frame(system.process(view(T, index, places)))
        system.finish()
        metrics.save(system, run, [], None, name)
    return folder / name


def merged(out: Path, *runs: Path) -> Run:
    return Run(merge_runs(MergeOptions(runs, out / "merged")).folder)


@pytest.fixture(scope="module", autouse=True)
def quick_plots() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot, "plot_trajectory", lambda path, *_: path.write_text("quick"))
        yield


@pytest.fixture(scope="module")
def runs(quick_plots: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with runs of both walks past the same markers of known size."""
    folder = tmp_path_factory.mktemp("runs")
    for name in WALKS:
        walk(folder, name)
    return folder


def off(marker: FoundMarker) -> Array:
    """Error (6,) of a marker's place in a merged map, which begins with the first walk."""
    T_plane_world = WALKS["first"][0]
    return se3_log(inverse(PLACES[marker.id]) @ T_plane_world @ marker.T_world_marker)


def assert_in_place(run: Run) -> None:
    """All markers where they hang, and both walks where they were."""
    for marker in run.markers.markers:
        assert np.abs(off(marker)[:3]).max() < 0.02, marker.id
        assert np.abs(off(marker)[3:]).max() < 0.005, marker.id
    for number, poses in enumerate(WALKS.values(), 1):
        found = read_tum(run.path / f"trajectory_run_{number}.txt").poses_world_camera
        true = inverse(WALKS["first"][0]) @ np.array(poses)
        assert np.abs(se3_log(inverse(true) @ found)).max() < 0.005


def test_a_marker_that_both_runs_saw_is_one(tmp_path: Path) -> None:
    """Its size was not given: what both runs have measured of it counts together."""
    free = MarkersConfig(enabled=True)
    alone = [walk(tmp_path, name, free) for name in WALKS]
    before = [{m.id: m for m in Run(path).markers.markers} for path in alone]
    both = merged(tmp_path, *alone)
    assert_in_place(both)
    found = {m.id: m for m in both.markers.markers}
    assert sorted(found) == [2, 4, 9]
    for number, marker in found.items():
        seen = [markers[number] for markers in before if number in markers]
        assert marker.used == sum(m.used for m in seen)
        assert marker.seen == sum(m.seen for m in seen)
        sizes = [m.size_m for m in seen]
        assert min(sizes) <= marker.size_m <= max(sizes)
        assert marker.size_m == pytest.approx(SIZE_M, rel=0.005)


def test_a_marker_that_was_moved_between_the_runs_is_said_and_harms_nothing(
    runs: Path, tmp_path: Path
) -> None:
    moved = PLACES | {4: on_the_plane(-0.7, 0.3)}
    alone = [runs / "first", walk(tmp_path, "second", places=moved)]
    both = merged(tmp_path, *alone)
    assert_in_place(both)
    found = {m.id: (m.seen, m.used) for m in both.markers.markers}
    first, second = ({m.id: m.used for m in Run(path).markers.markers} for path in alone)
    assert found == {
        2: (second[2], second[2]),
        4: (first[4] + second[4], first[4]),
        9: (first[9], first[9]),
    }
    said = [e.text for e in both.events if "more than the map can have drifted" in e.text]
    assert len(said) == 1
    assert said[0].startswith("marker 4 in keyframe")
    assert "is 0.29" in said[0] or "is 0.30" in said[0]


def test_the_site_of_known_poses_is_found_in_the_merged_map(tmp_path: Path) -> None:
    """Its marker is seen by the second run alone."""
    T_site_plane = se3_exp(np.array([0.0, 0.0, 0.0, 5.0, 1.0, -1.0]))
    T = T_site_plane @ PLACES[2]
    quaternion = quaternion_from_rotation(T[None, :3, :3])[0].tolist()
    known = replace(MARKERS, poses=((2, *T[:3, 3].tolist(), *quaternion),))
    alone = [walk(tmp_path, name, known) for name in WALKS]
    assert [Run(path).markers.T_world_site is None for path in alone] == [True, False]
    both = merged(tmp_path, *alone)
    assert_in_place(both)
    T_world_site = both.markers.T_world_site
    assert T_world_site is not None
    error = se3_log(T_site_plane @ WALKS["first"][0] @ T_world_site)
    assert np.abs(error[:3]).max() < 0.01
    assert np.abs(error[3:]).max() < 0.06  # five metres away


def test_markers_of_the_second_run_alone_are_kept(runs: Path, tmp_path: Path) -> None:
    """The first run looked for none; its settings of markers are those of the second then."""
    both = merged(tmp_path, walk(tmp_path, "first", MarkersConfig()), runs / "second")
    assert_in_place(both)
    assert [(m.id, m.size_m) for m in both.markers.markers] == [
        (number, pytest.approx(SIZE_M)) for number in (2, 4)
    ]


def test_markers_of_two_dictionaries_are_refused(runs: Path, tmp_path: Path) -> None:
    """The same number is another marker there."""
    other = shutil.copytree(runs / "second", tmp_path / "other") / "config.yaml"
    other.write_text(other.read_text().replace("APRILTAG_36h11", "APRILTAG_36h10"))
    text = "other: made with markers of APRILTAG_36h10, and .* those of APRILTAG_36h11"
    with pytest.raises(InputError, match=text):
        merged(tmp_path, runs / "first", other.parent)
