"""The last adjustment with all frames: new poses, and the map stays consistent."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_view import CAMERA, render_plane

from bmask_slam.back_end import frame_adjustment
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp, transform
from bmask_slam.graph.metrics import align
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig

FRAMES = 40


def path() -> list[Array]:
    """Sideways along the plane with turns, some of them fast."""
    return [
        se3_exp(np.array([0.03 * np.sin(0.5 * i), 0.05 * np.sin(0.3 * i), 0.01 * i, 0, 0, 0]))
        @ se3_exp(np.array([0, 0, 0, -0.6 + 0.025 * i, 0.05 * np.sin(0.4 * i), 0.0]))
        for i in range(FRAMES)
    ]


def tracked(**settings: bool) -> SlamSystem:
    """A system that has seen the plane with noise in its depth, not finished yet."""
    system = SlamSystem(CAMERA, SystemConfig(smooth_trajectory=False, **settings))
    rng = np.random.default_rng(3)
    for i, pose in enumerate(path()):
        frame = render_plane(pose, i)
        noise = rng.normal(0, 0.004, frame.depth_m.shape).astype(np.float32)
        system.process(replace(frame, depth_m=frame.depth_m + noise * frame.depth_m**2))
    return system


def errors_m(system: SlamSystem) -> Array:
    """Of all frames, relative to the best rigid place of the path (N,)."""
    found = system.trajectory()
    truth = np.array(path())[np.rint(found.timestamps_s * 30).astype(int)]
    T = align(found.positions_world, truth[:, :3, 3]).T_reference_estimate
    return np.linalg.norm(transform(T, found.positions_world) - truth[:, :3, 3], axis=1)


def rms_mm(system: SlamSystem) -> float:
    return 1e3 * float(np.sqrt(np.mean(errors_m(system) ** 2)))


def test_the_poses_of_all_frames_agree_with_the_truth() -> None:
    system = tracked()
    before = system.trajectory()
    system.finish()
    after = system.trajectory()
    assert len(after) == len(before) == FRAMES
    assert not np.any(
        np.all(before.poses_world_camera[1:] == after.poses_world_camera[1:], axis=(1, 2))
    )
    assert rms_mm(system) < 1.5


def test_map_and_graph_agree_afterwards(caplog: pytest.LogCaptureFixture) -> None:
    system = tracked()
    with caplog.at_level(logging.INFO):
        system.finish()
    (line,) = (text for text in caplog.messages if "adjusted together" in text)
    keyframes = system.map.world.keyframes
    assert f"{FRAMES - len(keyframes)} other frames" in line
    table = system.mapper.smoother.tables.keyframes
    for keyframe in keyframes.values():
        (pose,) = table.get(np.array([keyframe.id]))
        np.testing.assert_array_equal(keyframe.T_world_camera, pose)
    stamps = system.trajectory().timestamps_s.tolist()
    for keyframe in keyframes.values():
        found = system.trajectory().poses_world_camera[stamps.index(keyframe.timestamp_s)]
        np.testing.assert_allclose(found, keyframe.T_world_camera, atol=1e-12)
    before = rms_mm(system)
    system.mapper.finish()  # the graph can go on
    assert rms_mm(system) < 2 * before + 1


def test_a_run_that_was_saved_and_restored_ends_the_same(tmp_path: Path) -> None:
    system, again = tracked(), SlamSystem(CAMERA, SystemConfig(smooth_trajectory=False))
    again.restore({name: a.copy() for name, a in system.state().items()}, tmp_path)
    system.restart()
    for one in (system, again):
        one.finish()
    ours, theirs = system.trajectory(), again.trajectory()
    np.testing.assert_array_equal(ours.poses_world_camera, theirs.poses_world_camera)


def test_landmarks_that_were_fused_since_count_as_what_they_are_now() -> None:
    system = tracked()
    world, views = system.map.world, system.frame_observations.views
    known = system.mapper.smoother.tables.landmarks.contains(views[0].landmark_ids)
    gone, kept = views[0].landmark_ids[known][:2].tolist()
    world.replace_landmarks(np.array([gone]), np.array([kept]))
    _, given = frame_adjustment.frames_in(
        system.frame_observations.views,
        world,
        system.mapper.smoother.tables,
        system.map.history.trajectories(world).values(),
        CAMERA,
    )
    assert gone not in given.observations.landmark_ids
    assert np.count_nonzero(given.observations.landmark_ids == kept) > 0


@pytest.mark.parametrize("reason", ["failure", "size", "no frames"])
def test_a_map_that_cannot_be_adjusted_stays(
    reason: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def failing(*given: object) -> None:
        raise SolverError("the sensor is unplugged", None)

    system, alone = tracked(), tracked(adjust_frames=False)
    if reason == "failure":
        monkeypatch.setattr(frame_adjustment, "adjust_jointly", failing)
    elif reason == "size":
        monkeypatch.setattr(frame_adjustment, "MAX_OBSERVATIONS", 100)
    else:
        system.frame_observations.clear()
    for one in (system, alone):
        one.finish()
    assert ("unplugged" in caplog.text) == (reason == "failure")
    ours, theirs = system.trajectory(), alone.trajectory()
    np.testing.assert_array_equal(ours.poses_world_camera, theirs.poses_world_camera)


def test_what_another_camera_saw_is_not_used() -> None:
    system = tracked()
    assert system.frame_observations.views
    system.use_camera(replace(CAMERA, depth_time_offset_s=0.001), {})
    assert not system.frame_observations.views
