"""Sensors through the whole system: exact truth, blackouts, late measurements, saved states."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA, render_or_black

from bmask_slam.config.configuration import resolve
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.events import EventKind
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import GRAVITY, reference_frame_id
from bmask_slam.graph.files.array_file import read_arrays, write_arrays
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log, so3_exp
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.run_folder.map_file import MAP_FILE
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import TrackingStatus
from bmask_slam.world.frame_history import FrameHistory

MOUNTING = (0.1, 0.0, 0.4, 0.5, -0.5, 0.5, -0.5)
LEVER = (0.05, -0.2, 0.02)
SETTINGS = [
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0", "keyframes.late_shared=2.0"),
    *(f"sensors.odometry.camera_in_base={list(MOUNTING)}", "mapping.redundant_share=2.0"),
    *(f"sensors.position.antenna_in_camera={list(LEVER)}", "sensors.position.sigma_m=0.01"),
    *("sensors.accelerometer.enabled=true", "features.max_keypoints=300"),
]
CONFIG = resolve(SystemConfig, None, SETTINGS)
T_ENU_PLANE = make_pose(so3_exp(np.array([-1.5, 0.2, 0.4])), np.array([30.0, 20.0, 1.0]))
DARK = range(8, 22)


def poses() -> Array:
    """32 poses that curve along the plane; the first is the world's origin."""
    x = np.linspace(0, 0.9, 32)
    path = [se3_exp(np.array([0.1 * a, 0.2 * np.sin(5 * a), 0.3 * a, a, 0, 0])) for a in x]
    bent = make_pose(np.eye(3), np.stack([0 * x, 0.3 * np.sin(4 * x), 0.2 * x], axis=1))
    return np.asarray(inverse(path[0]) @ bent @ np.array(path))


POSES = poses()
STAMPS_S = np.arange(len(POSES)) / 30.0
T_BASE_CAMERA = T_of(MOUNTING)
FRAMES = [render_or_black(None if k in DARK else T, k) for k, T in enumerate(POSES)]


def odometry() -> tuple[Array, Array]:
    T_odom_world = se3_exp(np.array([0.2, 0.1, -2.0, 4.0, 5.0, 6.0]))
    return STAMPS_S, T_odom_world @ POSES @ inverse(T_BASE_CAMERA)


def positions() -> tuple[Array, Array]:
    antennas = POSES[:, :3, :3] @ np.array(LEVER) + POSES[:, :3, 3]
    return STAMPS_S, antennas @ T_ENU_PLANE[:3, :3].T + T_ENU_PLANE[:3, 3]


def forces() -> tuple[Array, Array]:
    """Of a camera at rest in each pose: up, in the accelerometer's frame."""
    up_world = T_ENU_PLANE[:3, :3].T @ [0.0, 0.0, 9.81]
    R = POSES[:, :3, :3] @ T_of(CONFIG.sensors.accelerometer.accelerometer_in_camera)[:3, :3]
    return STAMPS_S, (R.mT @ up_world[:, None])[:, :, 0]


def dark_run(system: SlamSystem, count: int = len(FRAMES)) -> list[TrackingStatus]:
    return [system.process(frame).status for frame in FRAMES[:count]]


@pytest.fixture(scope="module")
def reckoned() -> tuple[SlamSystem, list[TrackingStatus]]:
    """A run in which the camera is covered for nearly half a second, with every sensor."""
    system = SlamSystem(CAMERA, CONFIG)
    system.add_odometry(*odometry())
    system.add_position(*positions())
    system.add_accelerometer(*forces())
    statuses = dark_run(system)
    system.finish()
    return system, statuses


def test_in_a_blackout_odometry_gives_the_pose(
    reckoned: tuple[SlamSystem, list[TrackingStatus]],
) -> None:
    system, statuses = reckoned
    dark = [k for k, s in enumerate(statuses) if s is TrackingStatus.DEAD_RECKONING]
    assert dark == list(DARK)
    assert set(statuses) - {TrackingStatus.DEAD_RECKONING} <= {
        TrackingStatus.OK,
        TrackingStatus.WEAK,
    }
    assert len(system.segments()) == 1
    trajectory = system.trajectory()
    assert len(trajectory) == len(POSES)
    errors = se3_log(inverse(POSES) @ trajectory.poses_world_camera)
    assert np.abs(errors[:, 3:]).max() < 0.02
    assert np.abs(errors[:, :3]).max() < 0.02


def test_without_odometry_the_same_run_is_lost() -> None:
    statuses = dark_run(SlamSystem(CAMERA, CONFIG), 12)
    assert statuses[8:] == [TrackingStatus.LOST] * 4


def test_the_local_frame_is_where_it_was_put(
    reckoned: tuple[SlamSystem, list[TrackingStatus]],
) -> None:
    """World-from-ENU, by up and by the antenna's positions; signs, levers and mountings matter."""
    system, _ = reckoned
    tables = system.mapper.smoother.tables
    found = tables.keyframes.get(np.array([reference_frame_id(0)]))[0]
    off = se3_log(found @ T_ENU_PLANE)
    assert np.abs(off[:3]).max() < 0.02
    assert np.abs(off[3:]).max() < 0.03
    for kind in ("odometry", "gravity", "position"):
        factors = tables.relative_poses(kind)
        assert len(factors) > 5, kind
        assert system.mapper.smoother.relative_pose_errors(kind).chi2.max() < 20, kind


def test_a_saved_map_says_where_up_is(
    reckoned: tuple[SlamSystem, list[TrackingStatus]], tmp_path: Path
) -> None:
    """By the accelerometer alone: positions would give the frame a z too, but not gravity's."""
    reckoned[0].save_map(tmp_path / "map")
    found = read_saved_map(tmp_path).up_world
    assert found is not None
    np.testing.assert_allclose(found, T_ENU_PLANE[2, :3], atol=0.02)
    header, state = read_arrays(tmp_path / "map", MAP_FILE)
    kinds = state["mapper.graph.pose_factor_kinds"]
    kinds[kinds == GRAVITY] = "odometry"
    write_arrays(tmp_path / "map", MAP_FILE, header, state)
    assert read_saved_map(tmp_path).up_world is None


def test_a_restored_system_goes_on_identically_with_sensors() -> None:
    """In the middle of a blackout, to the last bit."""
    systems = [SlamSystem(CAMERA, CONFIG), SlamSystem(CAMERA, CONFIG)]
    systems[0].add_odometry(*odometry())
    systems[0].add_position(*positions())
    systems[0].add_accelerometer(*forces())
    dark_run(systems[0], 14)
    systems[0].restart()
    systems[1].restore(systems[0].state(), Path("run/checkpoint"))
    for system in systems:
        for frame in FRAMES[14:26]:
            system.process(frame)
        system.finish()
        system.mapper.update_ms = []
    first, second = (system.state() for system in systems)
    assert first.keys() == second.keys()
    assert "mapper.sensors.streams.odometry" in first
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], name)


def test_without_sensors_a_state_does_not_know_them() -> None:
    system = SlamSystem(CAMERA, CONFIG)
    dark_run(system, 3)
    assert not [name for name in system.state() if "sensors" in name]


def test_measurements_may_come_late_but_not_too_late() -> None:
    config = replace(CONFIG, sensors=replace(CONFIG.sensors, late_s=0.1))
    system = SlamSystem(CAMERA, config)
    stamps_s, T = odometry()
    dark_run(system, 5)
    system.add_odometry(stamps_s[:6], T[:6])  # newest keyframe: 0.13 s
    rows = system.mapper.sensors.streams.of("odometry")
    assert rows[:, 0].min() >= 4 / 30 - 0.1
    system.process(FRAMES[5])
    events = [event.text for event in system.process(FRAMES[6]).events]
    system.finish()
    assert system.mapper.sensors.refused == {"odometry": 1}
    assert len(system.mapper.smoother.relative_poses("odometry")) >= 3
    assert not events  # they were told with the frame before


def test_measurements_that_come_too_late_one_by_one_are_told_twice() -> None:
    """The first time, and how many there were at the end."""
    config = replace(CONFIG, sensors=replace(CONFIG.sensors, late_s=0.1))
    system = SlamSystem(CAMERA, config)
    dark_run(system, 5)
    stamps_s, T = odometry()
    for k in range(20):
        system.add_odometry(float(stamps_s[0]) - 1.0 + 0.01 * k, T[0])
    told = [e.text for e in system.process(FRAMES[5]).events if e.kind is EventKind.SENSOR]
    assert len(told) == 1
    assert "1 measurements up to -1.000 s refused" in told[0]
    system.finish()
    assert "odometry: 20 measurements came too late" in [e.text for e in system.events.take()]


def test_keyframes_that_no_force_was_measured_at_take_no_time(monkeypatch) -> None:
    """An accelerometer that begins late: the frames around all before were put together again."""
    asked: list[float] = []
    path = FrameHistory.path

    def counted(history: FrameHistory, *about: Any) -> Trajectory:
        asked.append(about[-1])
        return path(history, *about)

    monkeypatch.setattr(FrameHistory, "path", counted)
    system = SlamSystem(CAMERA, CONFIG)
    system.add_accelerometer(STAMPS_S + 9.0, forces()[1])
    dark_run(system, 6)
    assert len(system.mapper.world.keyframes) > 3 and not asked


def test_a_second_recordings_measurements_are_of_its_own_keyframes() -> None:
    """Its clock is behind the first one's, whose keyframes have other poses at those stamps."""
    system = SlamSystem(CAMERA, replace(CONFIG, sensors=replace(CONFIG.sensors, late_s=0.1)))
    for frame in FRAMES[:8]:
        system.process(replace(frame, timestamp_s=frame.timestamp_s + 0.2))
    first = system.mapper.world.next_keyframe_id
    system.begin_session()
    for add, measured in ((system.add_odometry, odometry), (system.add_position, positions)):
        stamps_s, values = measured()
        add(stamps_s[:8] + 0.1, values[:8])
    system.add_accelerometer(STAMPS_S[:8] + 0.1, forces()[1][:8])
    for frame in FRAMES[:8]:
        system.process(replace(frame, timestamp_s=frame.timestamp_s + 0.1))
    system.finish()
    assert not system.mapper.sensors.refused
    tables = system.mapper.smoother.tables
    for kind in ("odometry", "gravity", "position"):
        ends = [k for f in tables.relative_poses(kind) for k in f.keyframe_ids]
        assert len(ends) > 4, kind
        assert min(ends) >= first, kind
    again = SlamSystem(CAMERA, system.config)
    again.restore(system.state(), Path("run/checkpoint"))
    again.add_odometry(0.25, np.eye(4))  # newest keyframe: 0.33 s, of the other recording 0.43 s
    assert not again.mapper.sensors.refused


def test_a_sensor_that_is_not_enabled_is_refused() -> None:
    system = SlamSystem(CAMERA)
    with pytest.raises(InputError, match=r"set sensors.accelerometer.enabled to true"):
        system.add_accelerometer(*forces())
    with pytest.raises(InputError, match="3 stamps for 2 measurements"):
        system.add_position([0, 1, 2], np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"shape \(3, 3\); give finite poses"):
        system.add_odometry(0.0, np.eye(3))
