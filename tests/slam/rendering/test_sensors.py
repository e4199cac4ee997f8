"""The files of rendered sensors: of the motion that is rendered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, make_pose, se3_log, so3_exp
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.odometry import motion_between
from bmask_slam.graph.sensors.streams import COLUMNS, SensorStreams, read_folder
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sensors import GRAVITY_M_S2, POSITION_SIGMA_M, T_ENU_RENDERED, imu
from bmask_slam.rendering.sequence import render_sequence

CONFIG = RenderConfig("corridor", 31, fps=10.0, width=32, height=24, sensors=tuple(COLUMNS))


def test_the_sensors_of_a_rendered_sequence_fit_its_truth(tmp_path: Path) -> None:
    folder = render_sequence(CONFIG, tmp_path / "out")
    truth, config, streams = read_tum(folder / "groundtruth.txt"), SensorsConfig(), SensorStreams()
    for found in read_folder(folder, tuple(COLUMNS)):
        streams.add(found)
    poses = truth.poses_world_camera
    motion = motion_between(streams, 0.0, 3.0, config.odometry)
    assert motion is not None
    error = se3_log(inverse(motion.T_a_b) @ inverse(poses[0]) @ poses[30])
    assert error @ np.linalg.solve(motion.covariance, error) < 22.5  # 99.9 %
    fixes = streams.of("position")
    places = (T_ENU_RENDERED @ poses[::10])[:, :3, 3]
    np.testing.assert_allclose(fixes[:, 1:4], places, atol=4 * POSITION_SIGMA_M)
    force = streams.of("accelerometer")
    R_world, known = truth.at(force[:, 0], 1.0)
    sensor = T_of(config.accelerometer.accelerometer_in_camera)[:3, :3]
    mean = np.mean((R_world[known, :3, :3] @ sensor @ force[known, 1:4, None])[:, :, 0], axis=0)
    np.testing.assert_allclose(mean, [0, 0, GRAVITY_M_S2], atol=0.4)


def test_an_imu_that_turns_evenly_has_the_same_rate_from_first_to_last() -> None:
    rate_rad_s, hertz = np.array([0.3, -0.2, 0.5]), 200.0
    R = so3_exp(np.arange(20)[:, None] / hertz * rate_rad_s)
    quiet = {name: 0.0 for name in vars(ImuConfig()) if name.startswith("sigma")}
    config = replace(ImuConfig(imu_in_camera=(0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)), **quiet)
    rows = imu(make_pose(R, np.zeros((20, 3))), hertz, config, np.random.default_rng(0))
    np.testing.assert_allclose(rows[:, 1:4], np.tile(rate_rad_s, (20, 1)), atol=1e-9)


def test_an_unknown_sensor_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sensor 'sonar' is unknown; choose of odometry"):
        render_sequence(RenderConfig("corridor", 2, sensors=("sonar",)), tmp_path / "out")


@pytest.mark.parametrize("fps", [10.0, 500.0])
def test_a_single_image_has_sensors_too(tmp_path: Path, fps: float) -> None:
    config = replace(CONFIG, frames=1, fps=fps, sensors=("imu", "accelerometer"))
    folder = render_sequence(config, tmp_path / "out")
    assert [len(found.rows) >= 3 for found in read_folder(folder, config.sensors)] == [True] * 2
