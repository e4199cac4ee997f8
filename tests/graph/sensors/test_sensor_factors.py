"""Factors of sensors: zero at the truth, the right sign and unit off it, honest covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import RelativePose
from bmask_slam.graph.factors.gtsam_factors import FactorMaker
from bmask_slam.graph.factors.keys import keyframe_keys
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, se3_log, so3_exp
from bmask_slam.graph.sensors.accelerometer import (
    AccelerometerConfig,
    Upright,
    estimate_up,
    gravity_factor,
    plumb,
)
from bmask_slam.graph.sensors.config import SensorsConfig
from bmask_slam.graph.sensors.imu import ImuConfig
from bmask_slam.graph.sensors.markers import MarkersConfig
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.graph.sensors.odometry import OdometryConfig, motion_between
from bmask_slam.graph.sensors.planar import PlanarConfig, planar_factor
from bmask_slam.graph.sensors.position import PositionConfig, align, position_factor
from bmask_slam.graph.sensors.streams import (
    Measurements,
    SensorStreams,
    measurements,
    read_folder,
    read_measurements,
)
from bmask_slam.rendering.sensors import odometry

RNG = np.random.default_rng(4)
T_WORLD_REFERENCE = se3_exp(np.array([0.3, -0.8, 1.9, 20.0, -7.0, 3.0]))
MOUNTING = (0.3, -0.2, 0.9, 0.5, -0.5, 0.5, -0.5)
ODOMETRY = OdometryConfig(camera_in_base=MOUNTING)


def path(count: int) -> tuple[Array, Array]:
    """Stamps (N,) and poses (N, 4, 4) of a camera that moves about 10 m and turns."""
    stamps_s = 100.0 + np.arange(count) / 20.0
    steps = np.tile(se3_exp(np.array([0.01, 0.02, -0.005, 0.03, 0.01, 0.08])), (count - 1, 1, 1))
    poses = [se3_exp(np.array([1.0, 0.2, -2.0, 5.0, 4.0, 3.0]))]
    for step in steps:
        poses.append(poses[-1] @ step)
    return stamps_s, np.array(poses)


def chi2(factor: RelativePose, T_a: Array, T_b: Array) -> float:
    """Twice GTSAM's error of a factor without its kernel, a and b at these poses (4, 4)."""
    made = FactorMaker(Camera(640, 480, 500, 500, 320, 240), SmootherConfig()).pose_factor(
        replace(factor, robust=None)
    )
    values = gtsam.Values()
    for key, T in zip(keyframe_keys(np.array(factor.keyframe_ids)), (T_a, T_b), strict=True):
        values.insert(key, gtsam.Pose3(T))
    return 2 * made.error(values)


def streams(sensor: str, rows: Array) -> SensorStreams:
    found = SensorStreams()
    found.add(Measurements(sensor, rows))
    return found


# --- odometry ------------------------------------------------------------------------------------


def test_odometry_gives_the_cameras_motion_between_any_two_times() -> None:
    stamps_s, poses = path(100)
    quiet = replace(ODOMETRY, **dict.fromkeys(_sigmas(ODOMETRY), 0.0))
    rows = streams("odometry", odometry(poses, stamps_s, quiet, RNG))
    motion = motion_between(rows, stamps_s[10] + 0.025, stamps_s[60], ODOMETRY)
    assert motion is not None
    half = se3_log(inverse(poses[10]) @ poses[11]) / 2
    expected = inverse(poses[10] @ se3_exp(half)) @ poses[60]
    np.testing.assert_allclose(motion.T_a_b, expected, atol=1e-9)


def test_the_covariance_of_odometry_is_that_of_its_errors() -> None:
    """NEES within the 95 % band of 300 drawn motions, in each block and as a whole."""
    stamps_s, poses = path(60)
    truth, errors, whole = inverse(poses[5]) @ poses[55], [], []
    for seed in range(300):
        rows = odometry(poses, stamps_s, ODOMETRY, np.random.default_rng(seed))
        motion = motion_between(streams("odometry", rows), stamps_s[5], stamps_s[55], ODOMETRY)
        assert motion is not None
        errors.append(se3_log(inverse(motion.T_a_b) @ truth))
        whole.append(errors[-1] @ np.linalg.solve(motion.covariance, errors[-1]))
    assert 5.61 < np.mean(whole) < 6.41  # chi-square of 1800 degrees over 300, 95 %
    ratio = np.cov(np.array(errors).T).diagonal() / motion.covariance.diagonal()
    np.testing.assert_allclose(ratio, 1.0, atol=0.3)


def test_odometry_says_nothing_where_it_has_a_gap_or_ends() -> None:
    stamps_s, poses = path(60)
    rows = odometry(poses, stamps_s, ODOMETRY, RNG)
    holed = streams("odometry", np.delete(rows, slice(20, 30), axis=0))
    assert motion_between(holed, stamps_s[10], stamps_s[40], ODOMETRY) is None
    assert motion_between(holed, stamps_s[31], stamps_s[40], ODOMETRY) is not None
    ahead_s = stamps_s[-1] + 0.05
    assert motion_between(holed, stamps_s[40], ahead_s, ODOMETRY) is None
    assert motion_between(holed, stamps_s[40], ahead_s, ODOMETRY, 0.1) is not None
    assert motion_between(holed, 99.0, stamps_s[10], ODOMETRY) is None


def _sigmas(config: OdometryConfig) -> list[str]:
    return [name for name in vars(config) if name.startswith("sigma")]


# --- which way is up -----------------------------------------------------------------------------


def test_up_and_the_mounting_are_found_from_a_camera_that_turns() -> None:
    config = AccelerometerConfig(accelerometer_in_camera=(0, 0, 0, 0.5, 0.5, 0.5, 0.5))
    off = np.array([0.05, -0.03, 0.04])
    R_camera_sensor = so3_exp(off) @ T_of(config.accelerometer_in_camera)[:3, :3]
    up_world = T_WORLD_REFERENCE[:3, 2]
    R = so3_exp(RNG.normal(0, 0.7, (40, 3)))
    measured = []
    for R_world_camera in R:
        turned = so3_exp(np.linspace(-1, 1, 9)[:, None] * RNG.normal(0, 0.2, 3))
        force = 9.7 * ((R_world_camera @ turned @ R_camera_sensor).mT @ up_world)
        found = plumb(turned, force + RNG.normal(0, 0.01, force.shape), 9.7, config)
        assert found is not None
        measured.append(found)
    upright = estimate_up(R, measured, config)
    assert upright is not None
    np.testing.assert_allclose(upright.up_world, up_world, atol=0.01)
    np.testing.assert_allclose(upright.mounting_rad, off, atol=0.01)
    assert estimate_up(R[:2], measured[:2], config) is None
    assert abs(up_world @ upright.covariance @ up_world) < 1e-9


def test_a_gravity_factor_measures_roll_and_pitch_and_nothing_else() -> None:
    T_world_camera = se3_exp(np.array([0.4, 1.2, -0.9, 2.0, 3.0, -1.0]))
    config = AccelerometerConfig(accelerometer_in_camera=(0, 0, 0, 0, 0, 0, 1))
    up_camera = T_world_camera[:3, :3].T @ T_WORLD_REFERENCE[:3, 2]
    measured = plumb(np.eye(3)[None], 9.81 * up_camera[None], 9.81, config)
    assert measured is not None
    upright = Upright(T_WORLD_REFERENCE[:3, 2], np.zeros(3), np.eye(3))
    guess = inverse(T_WORLD_REFERENCE) @ T_world_camera @ se3_exp(np.full(6, 0.05))
    factor = gravity_factor((7, 3), guess, measured, upright)
    assert chi2(factor, T_WORLD_REFERENCE, T_world_camera) < 1e-3
    about_up = se3_exp(np.concatenate([0.8 * up_camera, [3.0, 2.0, 1.0]]))
    assert chi2(factor, T_WORLD_REFERENCE, T_world_camera @ about_up) < 1e-2
    side = np.cross(up_camera, [1.0, 0.0, 0.0])
    tilted = T_world_camera @ se3_exp(np.concatenate([0.06 * side / np.linalg.norm(side), [0] * 3]))
    assert chi2(factor, T_WORLD_REFERENCE, tilted) == pytest.approx((0.06 / 0.03) ** 2, rel=0.02)


# --- positions -----------------------------------------------------------------------------------


def test_a_position_factor_measures_where_the_antenna_is_and_nothing_else() -> None:
    T_world_camera = se3_exp(np.array([0.4, 1.2, -0.9, 2.0, 3.0, -1.0]))
    lever, config = np.array([0.4, -1.1, 0.3]), PositionConfig()
    T_reference_camera = inverse(T_WORLD_REFERENCE) @ T_world_camera
    antenna = (T_reference_camera @ np.append(lever, 1))[:3]
    guess = T_reference_camera @ se3_exp(np.full(6, 0.1))
    factor = position_factor((7, 3), guess, lever, np.append(antenna, 0.2), config)
    assert chi2(factor, T_WORLD_REFERENCE, T_world_camera) < 1e-4
    about_antenna = make_pose(np.eye(3), lever) @ se3_exp(np.array([0.5, -0.8, 0.3, 0, 0, 0]))
    turned = T_world_camera @ about_antenna @ make_pose(np.eye(3), -lever)
    assert chi2(factor, T_WORLD_REFERENCE, turned) < 1e-3
    moved = make_pose(np.eye(3), np.array([0.0, 0.4, 0.0])) @ T_world_camera
    assert chi2(factor, T_WORLD_REFERENCE, moved) == pytest.approx(4.0, rel=0.01)
    unknown = position_factor((7, 3), guess, lever, np.append(antenna, np.nan), config)
    assert chi2(unknown, T_WORLD_REFERENCE, moved) == pytest.approx(0.16, rel=0.01)


@pytest.mark.parametrize("straight", [False, True])
def test_the_local_frame_is_aligned_to_positions(straight: bool) -> None:
    """A straight path leaves the roll about itself open, unless up is known."""
    config = PositionConfig(sigma_m=0.05)
    along = np.linspace(0, 8, 12)[:, None]
    p = along * [1.0, 0.5, 0.1] + (0 if straight else np.sin(along) * [0.0, 2.0, 1.0])
    q = (p @ T_WORLD_REFERENCE[:3, :3].T) + T_WORLD_REFERENCE[:3, 3]
    rows = np.column_stack([p + RNG.normal(0, 0.02, p.shape), np.full(len(p), np.nan)])
    up = T_WORLD_REFERENCE[:3, 2]
    for known in (None, up):
        found = align(q, rows, known, config)
        if straight and known is None:
            assert found is None
            continue
        assert found is not None
        off = se3_log(inverse(found) @ T_WORLD_REFERENCE)
        assert np.abs(off[:3]).max() < 0.03
        assert np.abs(off[3:]).max() < 0.1
    assert align(q[:3], rows[:3], up, config) is None


# --- files and arguments -------------------------------------------------------------------------

GOOD = "1.0 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("sensor", "text", "reason"),
    [
        ("odometry", "", "no measurement in the file"),
        ("odometry", GOOD + "2.0 0 0 0 0 0 1\n", r"odometry.txt:2: 7 columns.*qw"),
        ("odometry", GOOD + "2.0 0 0 nan 0 0 0 1\n", r":2: 'nan' is not a finite number"),
        ("odometry", GOOD + "2.0 0 0 0 0 0 0 0\n", r":2: a zero quaternion"),
        ("position", "1.0 0 0 0 0.1\n2.0 0 0 0 -1\n", r":2: sigma -1 m is not positive"),
        ("position", "1.0 0 0 0\n2.0 5e6 0 0\n", r"5000 km from the first; give metres in a local"),
        ("accelerometer", "1e9 0 0 9\n2e9 0 0 9\n3e9 0 0 9\n", "looks like nanoseconds"),
    ],
)
def test_a_broken_file_is_one_clear_line(
    tmp_path: Path, sensor: str, text: str, reason: str
) -> None:
    file = tmp_path / f"{sensor}.txt"
    file.write_text(text)
    with pytest.raises(InputError, match=reason):
        read_measurements(file, sensor)


def test_lines_are_sorted_and_a_missing_sigma_is_unknown(tmp_path: Path) -> None:
    file = tmp_path / "position.txt"
    file.write_text("# x\n3.0 1 2 3 0.5\n1.0,4,5,6\n3.0 9 9 9\n")
    rows = read_measurements(file, "position").rows
    np.testing.assert_array_equal(rows, [[1, 4, 5, 6, np.nan], [3, 1, 2, 3, 0.5]])


@pytest.mark.parametrize(
    ("sensor", "rows", "reason"),
    [
        ("sonar", [[1, 2]], "'sonar' is no sensor; use one of odometry"),
        ("position", [[1, 2, 3]], r"shape \(1, 3\); give rows of timestamp x y z sigma"),
        ("position", [[1, 2, 3, np.inf]], "row 0 has a value that is not finite"),
        ("accelerometer", [[2, 0, 0, 9], [1, 0, 0, 9]], "stamp of row 1 does not rise"),
    ],
)
def test_what_is_no_measurement_is_refused(sensor: str, rows: list[float], reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        measurements(sensor, np.array(rows, float))


def test_the_files_of_the_present_folder_are_read_and_a_strange_one_names_the_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("position.txt").write_text("1.5 1 2 3\n")
    Path("odometry.txt").write_text("a file of another program\n")
    assert not read_folder(None, ("position",))
    (found,) = read_folder(Path(), ("position",))
    np.testing.assert_array_equal(found.rows[:, :4], [[1.5, 1, 2, 3]])
    with pytest.raises(InputError, match=r"--set sensors\.odometry\.enabled=false"):
        read_folder(Path(), ("odometry", "position"))


# --- planar motion -------------------------------------------------------------------------------


def test_a_planar_factor_holds_height_and_tilt_of_the_base_and_nothing_else() -> None:
    config = PlanarConfig(camera_in_base=MOUNTING, sigma_height_m=0.01, sigma_tilt_rad=0.02)
    T_world_plane, T_base_camera = T_WORLD_REFERENCE, T_of(MOUNTING)
    on_plane = se3_exp(np.array([0, 0, 1.1, 0, 0, 0])) @ make_pose(
        np.eye(3), np.array([3.0, -2, 0])
    )
    guess = on_plane @ se3_exp(np.array([0.03, -0.02, 0, 0, 0, 0.02])) @ T_base_camera
    factor = planar_factor((7, 3), guess, config)

    def off(change: list[float]) -> float:
        T_world_base = T_world_plane @ on_plane @ se3_exp(np.array(change))
        return chi2(factor, T_world_plane, T_world_base @ T_base_camera)

    assert off([0, 0, 0, 0, 0, 0]) < 0.01
    assert off([0, 0, 1.5, 2.0, -3.0, 0]) < 0.01  # heading and place
    assert off([0, 0, 0, 0, 0, 0.02]) == pytest.approx(4, rel=0.05)
    assert off([0.04, 0, 0, 0, 0, 0]) == pytest.approx(4, rel=0.05)
    assert off([0, -0.04, 0, 0, 0, 0]) == pytest.approx(4, rel=0.05)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"imu": ImuConfig(gravity_m_s2=0.0)}, "sensors.imu.gravity_m_s2 = 0: give a positive"),
        ({"imu": ImuConfig(sigma_accelerometer_bias=np.inf)}, "sensors.imu.sigma_accelerometer_b"),
        ({"markers": MarkersConfig(size_sigma=0.0)}, "sensors.markers.size_sigma = 0"),
        (
            {"accelerometer": AccelerometerConfig(sigma_mounting_rad=-0.1)},
            "sensors.accelerometer.sigma_mounting_rad = -0.1",
        ),
        (
            {"odometry": OdometryConfig(camera_in_base=(1.0, 0, 0, 0, 0, 0, 0))},
            r"sensors.odometry.camera_in_base: \(1.0, 0.* give seven numbers",
        ),
        (
            {"markers": MarkersConfig(poses=((7, 0, np.nan, 0, 0, 0, 0, 1),))},
            "sensors.markers.poses: 7: .* give seven numbers",
        ),
    ],
)
def test_settings_that_a_sensor_cannot_have_are_refused_at_once(
    config: dict[str, Any], message: str
) -> None:
    """They divided by zero, or ended a run in its middle."""
    with pytest.raises(InputError, match=message):
        SensorsConfig(**config)
