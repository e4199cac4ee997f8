"""An IMU through the whole system: a covered camera, saved states, gaps, joined segments."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_view import CAMERA, render_or_black

from bmask_slam.config.configuration import resolve
from bmask_slam.dense.saved_map import read_saved_map
from bmask_slam.events import Event, EventKind
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.geometry import inverse, make_pose, se3_log, so3_exp
from bmask_slam.graph.inertial.tables import ImuModel
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.rendering.sensors import imu
from bmask_slam.sensing.inertial_fusion import inertial_update
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult, TrackingStatus

HERTZ, FPS = 200.0, 10.0
MOUNTING = (0.05, -0.1, 0.02, 0.5, -0.5, 0.5, -0.5)
SETTINGS = [
    *("keyframes.min_interval_frames=1", "keyframes.max_shared=2.0", "keyframes.late_shared=2.0"),
    *(f"sensors.imu.imu_in_camera={list(MOUNTING)}", "mapping.redundant_share=2.0"),
    "features.max_keypoints=300",
]
CONFIG = resolve(SystemConfig, None, SETTINGS)
R_UPRIGHT_WORLD = so3_exp(np.array([-1.5, 0.2, 0.4]))
DARK = range(18, 30)
BIAS = np.array([0.01, -0.02, 0.015])


def poses(times_s: Array) -> Array:
    """A camera that swings before the plane; its pose at the time 0 is the world's origin."""
    t = np.concatenate([[0.0], times_s])[:, None]
    p = [0.25, 0.15, 0.2] * np.sin(t * [1.1, 1.7, 1.3] + [0.0, 0.5, 1.0])
    path = make_pose(so3_exp([0.1, 0.12, 0.2] * np.sin(t * [1.6, 1.2, 0.9] + [0.3, 0.1, 0.8])), p)
    return np.asarray(inverse(path[0]) @ path[1:])


STAMPS_S = np.arange(33) / FPS
POSES = poses(STAMPS_S)


def readings() -> Array:
    """Rows (N, 7) of an IMU without noise, with a bias of its gyroscope."""
    fine = poses(np.arange(-0.1, 3.5, 1 / HERTZ))
    quiet = {name: 0.0 for name in vars(CONFIG.sensors.imu) if name.startswith("sigma")}
    upright = make_pose(R_UPRIGHT_WORLD, np.zeros(3)) @ fine
    rows = imu(upright, HERTZ, replace(CONFIG.sensors.imu, **quiet), np.random.default_rng(0))
    rows[:, 0] -= 0.1
    rows[:, 1:4] += BIAS
    return rows


def run(system: SlamSystem, frames: range) -> list[FrameResult]:
    results = []
    for k in frames:
        frame = render_or_black(None if k in DARK else POSES[k], k)
        results.append(system.process(replace(frame, timestamp_s=float(STAMPS_S[k]))))
    return results


def with_imu(rows: Array) -> SlamSystem:
    system = SlamSystem(CAMERA, CONFIG)
    system.add_imu(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    return system


@pytest.fixture(scope="module")
def bridged() -> tuple[SlamSystem, SlamSystem, list[FrameResult]]:
    """A run whose camera is covered for a second, and one that was restored in the middle."""
    first, second = with_imu(readings()), SlamSystem(CAMERA, CONFIG)
    results = run(first, range(23))
    first.restart()
    second.restore(first.state(), Path("run/checkpoint"))
    for system in (first, second):
        more = run(system, range(23, 33))
        system.finish()
        system.mapper.update_ms = []
    return first, second, results + more


def test_the_imu_alone_gives_the_pose_of_a_covered_camera_for_a_second(
    bridged: tuple[SlamSystem, SlamSystem, list[FrameResult]],
) -> None:
    system, _, results = bridged
    dark = [k for k, r in enumerate(results) if r.status is TrackingStatus.DEAD_RECKONING]
    assert dark == list(DARK)
    kinds = [event.kind for result in results for event in result.events]
    assert kinds.count(EventKind.SEGMENT) == 1  # where the view comes back none begins
    trajectory = system.trajectory()
    assert len(trajectory) == len(POSES)
    off = se3_log(inverse(POSES) @ trajectory.poses_world_camera)
    assert np.abs(off[:, 3:]).max() < 0.02
    assert np.abs(off[:, :3]).max() < 0.01


def test_gravity_and_biases_are_found(
    bridged: tuple[SlamSystem, SlamSystem, list[FrameResult]], tmp_path: Path
) -> None:
    """In the world, the first camera's; a wrong mounting or sign turns both."""
    bridged[0].save_map(tmp_path / "map")
    up_world = read_saved_map(tmp_path).up_world
    assert up_world is not None
    np.testing.assert_allclose(up_world, R_UPRIGHT_WORLD.T @ [0, 0, 1], atol=0.01)
    inertial = bridged[0].mapper.smoother.tables.inertial
    assert len(inertial.factors) > 15
    np.testing.assert_allclose(inertial.down[0], R_UPRIGHT_WORLD.T @ [0, 0, -1], atol=0.01)
    last = inertial.states[max(inertial.states)]
    np.testing.assert_allclose(last[6:], BIAS, atol=3e-3)
    step = poses(STAMPS_S[-1:] + 0.01) - poses(STAMPS_S[-1:] - 0.01)
    np.testing.assert_allclose(last[:3], step[0, :3, 3] / 0.02, atol=0.03)


def test_a_restored_system_goes_on_identically_with_an_imu(
    bridged: tuple[SlamSystem, SlamSystem, list[FrameResult]],
) -> None:
    first, second = (system.state() for system in bridged[:2])
    assert "mapper.graph.imu_readings" in first
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], name)


def test_how_the_camera_moved_in_an_earlier_recording_is_not_gone_on_with() -> None:
    """The next one may have the same stamps; until its own IMU says more, nothing is known."""
    system = with_imu(readings())
    run(system, range(18))
    assert system.mapper.sensors.newest is not None
    first = system.mapper.world.next_keyframe_id
    system.begin_session()
    rows = readings()
    system.add_imu(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    for k in range(4):
        run(system, range(k, k + 1))
        newest = system.mapper.sensors.newest
        assert newest is None or newest.keyframe >= first
    assert system.mapper.world.next_keyframe_id > first


def test_a_restored_session_without_measurements_yet_knows_where_it_began() -> None:
    """Else the stamps of what comes are compared with those of the earlier recording."""
    system, restored = SlamSystem(CAMERA, CONFIG), SlamSystem(CAMERA, CONFIG)
    run(system, range(8))
    system.begin_session()
    restored.restore(system.state(), Path("run/checkpoint"))
    rows = readings()
    for one in (system, restored):
        one.add_imu(rows[:, 0] - 20.0, rows[:, 1:4], rows[:, 4:])  # this recording was made before
        assert not one.mapper.sensors.refused
        assert len(one.mapper.sensors.streams.of("imu")) == len(rows)


def test_a_saved_graph_has_the_imu_and_loses_it_with_its_keyframes(
    bridged: tuple[SlamSystem, SlamSystem, list[FrameResult]], tmp_path: Path
) -> None:
    smoother = bridged[0].mapper.smoother
    smoother.save(tmp_path / "graph")
    again = Smoother.load(tmp_path / "graph")
    pairs = sorted(smoother.tables.inertial.factors)
    assert sorted(again.tables.inertial.factors) == pairs
    again.update(GraphUpdate())
    middle = pairs[5][1]
    again.update(GraphUpdate(remove_keyframes=np.array([middle])))
    left = again.tables.inertial
    assert not [pair for pair in left.factors if middle in pair]
    assert len(left.factors) == len(pairs) - 2
    assert middle not in left.states
    assert ("bias", pairs[6][1], 0) in left.slots
    assert np.isfinite(again.marginals().keyframes).all()


def test_a_mounting_that_is_not_given_is_estimated_and_used() -> None:
    """Reported with its sigma; restored in the middle: the same bytes."""
    free = replace(CONFIG.sensors.imu, imu_in_camera=None)
    config = replace(CONFIG, sensors=replace(CONFIG.sensors, imu=free))
    rows = readings()
    first, second = SlamSystem(CAMERA, config), SlamSystem(CAMERA, config)
    first.add_imu(rows[:, 0], rows[:, 1:4], rows[:, 4:])
    frames = [replace(render_or_black(POSES[k], k), timestamp_s=STAMPS_S[k]) for k in range(30)]
    events: list[Event] = []
    for frame in frames[:25]:
        events += first.process(frame).events
    first.restart()
    second.restore(first.state(), Path("run/checkpoint"))
    for system in (first, second):
        for frame in frames[25:]:
            events += system.process(frame).events
        system.finish()
        system.mapper.update_ms = []
    said = [event.text for event in events if event.kind is EventKind.SENSOR]
    assert said[0].startswith("imu: mounting estimated, sensors.imu.imu_in_camera=[")
    found = first.mapper.sensors.imu
    T = T_of((*found.found[:7].tolist(),))
    off = se3_log(inverse(T_of(MOUNTING)) @ T)
    assert np.linalg.norm(off[:3]) < 4 * found.sigma_rad < 0.02
    inertial = first.mapper.smoother.tables.inertial
    assert len(inertial.factors) > 5
    down = R_UPRIGHT_WORLD.T @ [0.0, 0.0, -1.0]
    assert np.arccos(inertial.down[0] @ down) < 0.03
    states = [system.state() for system in (first, second)]
    for name in states[0]:
        np.testing.assert_array_equal(states[0][name], states[1][name], name)
    found.found = found.found + np.eye(8)[0] * 0.01  # better known: all is made anew
    first.mapper.add_waiting_measurements()
    inertial = first.mapper.smoother.tables.inertial
    assert {f.model.T_camera_imu[0, 3] for f in inertial.factors.values()} == {found.found[0]}
    names = [name for name in inertial.slots if name[0] == "imu"]
    assert sorted(name[1:] for name in names) == sorted(inertial.factors)
    assert not [name for name in inertial.slots if name[0] == "replaced"]


def test_the_mounting_is_put_together_once_for_all_keyframes(monkeypatch) -> None:
    """For each pair of keyframes it took 100 ms a keyframe in a map of 2000."""
    made: list[ImuModel] = []
    of = ImuConfig.model.fget

    def counted(config: ImuConfig) -> ImuModel:
        made.append(of(config))
        return made[-1]

    system = with_imu(readings())
    run(system, range(12))
    keyframes = list(system.mapper.world.keyframes.values())
    tables, streams = system.mapper.smoother.tables.inertial, system.mapper.sensors.streams
    monkeypatch.setattr(ImuConfig, "model", property(counted))
    assert not inertial_update(keyframes, tables, streams, CONFIG.sensors.imu)
    assert len(keyframes) > 8 and len(made) == 1
