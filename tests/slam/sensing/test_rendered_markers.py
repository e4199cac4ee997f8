"""Markers from images to the run folder: a rendered room with exact truth, resumed, and by hand."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import bmask_slam
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, make_pose, rotation_from_quaternion, se3_log
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.markers import MARKER_SIZE_M, TRUTH
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

RENDERED = RenderConfig("office", 10, fps=4.0, width=320, height=240, sensors=("markers",))
SETTINGS = {
    "sensors.markers.enabled": True,
    "sensors.markers.size_m": MARKER_SIZE_M,
    "keyframes.min_interval_frames": 1,
    "keyframes.max_shared": 2.0,
}


@pytest.fixture(scope="session")
def room(rendered: Callable[[RenderConfig], Path]) -> Path:
    """Two and a half seconds of the office with markers on its walls, in small images."""
    return rendered(RENDERED)


def true_markers(folder: Path) -> dict[int, Array]:
    """T_world_marker (4, 4) by number, in the frame of the ground truth."""
    rows = np.loadtxt(folder / TRUTH, ndmin=2)
    return {int(r[0]): make_pose(rotation_from_quaternion(r[4:]), r[1:4]) for r in rows}


@pytest.fixture(scope="session")
def runs(room: Path, tmp_path_factory: pytest.TempPathFactory) -> list[bmask_slam.Run]:
    """Runs over the room with and without markers."""
    out = tmp_path_factory.mktemp("runs")
    given = {"segmenter": "none", "calibrate": "off"}
    without = {**SETTINGS, "sensors.markers.enabled": False}
    return [
        bmask_slam.run(room, out / name, settings=settings, **given)  # type: ignore[arg-type]
        for name, settings in (("with", SETTINGS), ("without", without))
    ]


def test_markers_of_a_rendered_room_are_where_they_hang(
    room: Path, runs: list[bmask_slam.Run]
) -> None:
    """In the map, by the truth of the renderer: units, frames, corners and files."""
    run, truth = runs[0], true_markers(room)
    reference = open_sequence(room).groundtruth
    assert reference is not None
    (T_truth_world,), _ = reference.at(run.keyframes.timestamps_s[:1], 0.1)
    found = run.markers
    assert found.dictionary == "APRILTAG_36h11"
    assert len(found.markers) >= 2
    for marker in found.markers:
        error = se3_log(inverse(truth[marker.id]) @ T_truth_world @ marker.T_world_marker)
        assert np.linalg.norm(error[:3]) < 0.02, marker.id
        assert np.linalg.norm(error[3:]) < 0.02, marker.id
        assert (marker.seen, marker.size_m) == (marker.used, pytest.approx(MARKER_SIZE_M, rel=1e-3))


def test_a_run_with_markers_is_not_worse(runs: list[bmask_slam.Run]) -> None:
    errors = [run.metrics["ate_rmse"].value for run in runs]
    assert errors[0] < errors[1] + 0.0005
    assert runs[0].metrics["graph_markers_used"].value >= 4
    assert any("markers seen" in event.text for event in runs[0].events)
    assert "graph_markers_used" not in runs[1].metrics
    assert not (runs[1].path / "markers.json").exists()


def test_a_restored_system_goes_on_identically_with_markers(room: Path) -> None:
    config = resolve(SystemConfig, None, [f"{k}={v}" for k, v in SETTINGS.items()])
    sequence = open_sequence(room)
    systems = [SlamSystem(sequence.camera, config), SlamSystem(sequence.camera, config)]
    for k in range(6):
        systems[0].process(sequence.load(k))
    systems[0].restart()
    systems[1].restore(systems[0].state(), Path("run/checkpoint"))
    for system in systems:
        for k in range(6, 8):
            system.process(sequence.load(k))
        system.finish()
        system.mapper.update_ms = []
    first, second = (system.state() for system in systems)
    assert len(first["mapper.sensors.streams.markers"]) >= 3
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], name)
