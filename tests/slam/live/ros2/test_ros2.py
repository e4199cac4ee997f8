"""ROS 2 over DDS: bytes as rosbags', and a second process that plays frames and hears poses."""

from __future__ import annotations

import json
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from ros2_messages import example_message
from ros2_player import (
    BEGIN_S,
    PLACES,
    T_BASE_CAMERA,
    T_ODOM_MAP,
    Player,
    T_odom_base,
    info,
    place,
    pose,
)
from ros2_processes import LOOPBACK, begin_process

from bmask_slam.cli import main
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import (
    inverse,
    make_pose,
    rotation_from_quaternion,
    se3_exp,
    se3_log,
)
from bmask_slam.graph.sensors.mounting import T_of
from bmask_slam.live.ros2.dds import DdsNode, carried_type, dds_name, ros_name
from bmask_slam.live.ros2.messages import ros_covariance
from bmask_slam.live.ros2.outputs import OPTICAL, Ros2Frames
from bmask_slam.live.ros2.transport import SENSOR, STATE, Quality, typestore
from bmask_slam.live.sources import opening
from bmask_slam.live.sources.opening import SourceOptions, open_source
from bmask_slam.system_config import SystemConfig

TYPES = (
    "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
    "sensor_msgs/msg/Imu", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path", "nav_msgs/msg/OccupancyGrid", "tf2_msgs/msg/TFMessage",
    "geometry_msgs/msg/PoseWithCovarianceStamped", "visualization_msgs/msg/MarkerArray",
    "diagnostic_msgs/msg/DiagnosticArray", "vision_msgs/msg/Detection3DArray",
    "sensor_msgs/msg/NavSatFix", "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PointStamped",
    *(f"std_srvs/srv/{name}_{way}" for name in ("Trigger", "SetBool")
      for way in ("Request", "Response")),
)  # fmt: skip
DOMAIN, FRAMES = 77, 10


@pytest.mark.parametrize("name", TYPES)
def test_bytes_are_those_of_rosbags(name: str) -> None:
    for seed in range(6):
        ours = example_message(name, np.random.default_rng(seed), True)
        theirs = example_message(name, np.random.default_rng(seed))
        expected = bytes(typestore().serialize_cdr(theirs, name))
        found = ours.serialize(use_version_2=False)
        assert found[4:] == expected[4:].ljust(len(found) - 4, b"\0")
        assert found[:2] == expected[:2] == b"\x00\x01"  # CDR, little endian
        back = carried_type(name).deserialize(found)
        assert type(typestore().deserialize_cdr(back.cdr, name)) is type(theirs)


def test_names_of_types() -> None:
    assert dds_name("sensor_msgs/msg/Image") == "sensor_msgs::msg::dds_::Image_"
    assert ros_name("sensor_msgs::msg::dds_::Image_") == "sensor_msgs/msg/Image"
    assert ros_name("other::Type") == ""
    assert carried_type("sensor_msgs/msg/Image").__idl__.idl_transformed_typename == (
        "sensor_msgs::msg::dds_::Image_"
    )


def test_the_covariance_is_that_of_the_bases_pose() -> None:
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T * 1e-6
    T_base_camera, T_map_base = (se3_exp(rng.normal(size=6)) for _ in range(2))
    found = ros_covariance(covariance, T_base_camera, T_map_base)
    J = np.zeros((6, 6))
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = 1e-6
        moved = T_map_base @ T_base_camera @ se3_exp(xi) @ inverse(T_base_camera)
        turn = moved[:3, :3] @ T_map_base[:3, :3].T  # about the map's axes
        J[:3, axis] = (moved - T_map_base)[:3, 3] / 1e-6
        J[3:, axis] = se3_log(make_pose(turn, np.zeros(3)))[:3] / 1e-6
    assert np.allclose(found, J @ covariance @ J.T, rtol=1e-4, atol=1e-12)


def test_frames_are_checked() -> None:
    with pytest.raises(InputError, match="16 numbers"):
        Ros2Frames(base_camera=(1.0,) * 16)
    level = OPTICAL[:3, :3] @ np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]).T
    assert np.allclose(level, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])  # forward, right, down


@pytest.mark.parametrize("text", ["ros2:x", "ros2:500"])
def test_other_domains_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="domain"):
        open_source(text, SourceOptions(silence_s=0.1))


def test_the_domain_is_that_of_the_environment_or_given(monkeypatch) -> None:
    def join(domain: int) -> None:
        raise InputError(f"joined {domain}.")

    monkeypatch.setattr(opening, "DdsNode", join)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    for variable, text, expected in (
        ("", "ros2:", "joined 0"), ("42", "ros2:", "joined 42"), ("42", "ros2:7", "joined 7"),
        ("x", "ros2:", "'x' is no domain"),
    ):  # fmt: skip
        if variable:
            monkeypatch.setenv("ROS_DOMAIN_ID", variable)
        with pytest.raises(InputError, match=rf"{expected}\b"):
            open_source(text, SourceOptions())


@pytest.mark.parametrize("sent", [SENSOR, STATE], ids=["best effort", "reliable"])
def test_images_are_taken_of_best_effort_as_ros_sends_them(sent: Quality, monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    camera, listener = DdsNode(DOMAIN + 2), DdsNode(DOMAIN + 2)
    writer = camera.writer("/camera_info", "sensor_msgs/msg/CameraInfo", sent)
    reader = listener.reader("/camera_info", "sensor_msgs/msg/CameraInfo")
    end_s, heard = time.monotonic() + 60, []
    while not heard and time.monotonic() < end_s:  # what was sent before both knew it is lost
        writer.send(info(12.5))
        time.sleep(0.02)
        heard = list(reader.take())
    assert heard[0].width == 640
    assert heard[0].header.stamp.sec == 12


def test_names_without_a_slash_are_those_of_ros(monkeypatch) -> None:
    """As of a ``prefix`` without one; ROS would not see a DDS topic rtrobot/path."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    robot, listener = DdsNode(DOMAIN + 2), DdsNode(DOMAIN + 2)
    writers = [robot.writer(name, "nav_msgs/msg/Path") for name in ("robot/path", "/other/path")]
    end_s, seen = time.monotonic() + 60, {}
    while not {"/robot/path", "/other/path"} <= seen.keys() and time.monotonic() < end_s:
        time.sleep(0.02)
        seen = listener.published()
    assert seen["/robot/path"] == seen["/other/path"] == "nav_msgs/msg/Path"
    assert len(writers) == 2  # they have been there all the time


def test_compressed_images_become_frames(monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    player, ended = Player(DdsNode(DOMAIN + 5), compressed=True), threading.Event()

    def play() -> None:
        k = 0
        while not ended.wait(0.1):
            player.play(k)
            k += 1

    playing = threading.Thread(target=play)
    playing.start()
    try:
        options = SourceOptions(silence_s=60, reliable=True)
        source = open_source(f"ros2:{DOMAIN + 5}", options)
        frame = next(source.frames())
    finally:
        ended.set()
        playing.join(10)
    sent = player.rendered[place(round(30 * (frame.timestamp_s - BEGIN_S)))]
    off = np.abs(frame.rgb.astype(int) - sent.rgb)
    assert 0 < off.mean() < 3  # of JPEG
    assert np.nanmax(np.abs(frame.depth_m - sent.depth_m)) < 0.00051
    assert np.array_equal(np.isnan(frame.depth_m), np.isnan(sent.depth_m))


def check_poses(odometry: list[dict]) -> None:
    """Received poses of the base are those of the player's frames."""
    for one in odometry:
        k = round(30 * (one["stamp_s"] - BEGIN_S))
        R = rotation_from_quaternion(np.array(one["quaternion"]))
        found = make_pose(R, np.array(one["position"]))
        expected = T_BASE_CAMERA @ inverse(pose(0)) @ pose(k) @ inverse(T_BASE_CAMERA)
        assert np.allclose(found, expected, atol=0.003)


def test_a_second_process_plays_frames_and_hears_poses(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    with begin_process("ros2_player", DOMAIN, 10, tmp_path / "heard") as player:
        out = tmp_path / "run"
        options = (
            "--segmenter",
            "none",
            "--odometry-topic",
            "/odom",
            "--calibrate",
            "off",
            "--quiet",
            "--silence",
            "300",
            "--reliable",  # on a full machine of best effort hardly an image is whole
        )
        code = main(["live", f"ros2:{DOMAIN}", "--out", str(out), "--max-frames", str(FRAMES - 2),
                     *options])  # fmt: skip
        player.communicate(timeout=60)
        assert (code, player.returncode) == (0, 0)
    heard = json.loads((tmp_path / "heard").read_text())
    odometry = heard["/bmask_slam/odometry"]
    assert len(odometry) >= FRAMES - 4  # of best effort
    assert {(o["frame"], o["child"]) for o in odometry} == {("map", "base_link")}
    check_poses(odometry)
    for topic in ("/bmask_slam/odometry", "/bmask_slam/pose"):
        received = np.array([one["covariance"] for one in heard[topic][1:]]).reshape(-1, 6, 6)
        sigmas = np.sqrt(np.linalg.eigvalsh(received))  # the first begins the map and has none
        assert np.all((sigmas > 1e-6) & (sigmas < 0.03))  # rad, m
    links = {tuple(link) for tf in heard["/tf"] + heard["/tf_static"] for link in tf["links"]}
    assert links == {("map", "odom"), ("base_link", "camera")}  # the second is the player's
    assert np.allclose(heard["/tf"][-1]["moved"], inverse(T_ODOM_MAP)[:3, 3], atol=0.003)
    assert heard["/bmask_slam/landmarks"][-1]["points"] > 50
    assert heard["/bmask_slam/landmarks"][-1]["fields"] == ["x", "y", "z", "rgb"]
    # the path is sent once more at the end
    saved = (out / "trajectory.txt").read_text().splitlines()
    assert heard["/bmask_slam/path"][-1]["poses"] == sum(line[0] != "#" for line in saved) >= 1
    assert heard["/diagnostics"][-1]["status"] == "OK"
    assert len(heard["/bmask_slam/pose"]) == len(odometry)
    mounting = resolve(SystemConfig, out / "config.yaml").sensors.odometry.camera_in_base
    assert np.allclose(T_of(mounting), T_BASE_CAMERA)


def test_odometry_of_a_second_process_by_tf_and_other_frames(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    out, domain = tmp_path / "run", DOMAIN + 6
    params = tmp_path / "params.yaml"
    params.write_text("map: world\ntf_ahead_s: 0.2\n")
    options = ("--segmenter", "none", "--calibrate", "off", "--quiet", "--silence", "60",
               "--ros2-params", str(params))  # fmt: skip
    with begin_process("ros2_player", domain, 10, tmp_path / "heard", "--tf") as player:
        code = main(["live", f"ros2:{domain}", "--out", str(out), "--max-frames", str(FRAMES - 2),
                     "--reliable", *options])  # fmt: skip
        player.communicate(timeout=60)
        assert (code, player.returncode) == (0, 0)
    heard = json.loads((tmp_path / "heard").read_text())
    check_poses(heard["/bmask_slam/odometry"])
    assert {one["frame"] for one in heard["/bmask_slam/odometry"]} == {"world"}
    log = (out / "log.txt").read_text()
    assert log.count("/tf has odom -> base_link, which is not published, and used as odometry") == 1
    mounting = resolve(SystemConfig, out / "config.yaml").sensors.odometry.camera_in_base
    assert np.allclose(T_of(mounting), T_BASE_CAMERA)
    moved = {"odom": [], "base_link": []}  # type: ignore[var-annotated]
    for one in heard["/tf"]:
        for link, at in zip(one["links"], one["moved"], strict=True):
            assert link in (["odom", "base_link"], ["world", "odom"])
            moved[link[1]].append(at)
    assert np.allclose(moved["odom"][-1], inverse(T_ODOM_MAP)[:3, 3], atol=0.003)
    wheels = np.array([T_odom_base(k)[:3, 3] for k in range(PLACES)])
    off_m = np.linalg.norm(wheels[:, None] - moved["base_link"], axis=2).min(axis=0)
    assert off_m.max() < 1e-9  # the wheels' own alone


def test_a_player_is_killed_and_started_again(tmp_path: Path, monkeypatch) -> None:
    """The second one's first frame is where the first one began, 3 s later."""
    monkeypatch.setenv("CYCLONEDDS_URI", LOOPBACK)
    again, out, players, ended = 90, tmp_path / "run", [], threading.Event()

    def play() -> None:
        for name, *words in (("killed", "--die-after", 3), ("again", "--first", again)):
            if not ended.is_set():
                given = DOMAIN + 4, 10, tmp_path / name, *words
                players.append(begin_process("ros2_player", *given))
                players[-1].wait(600)

    playing = threading.Thread(target=play)
    playing.start()
    options = ("--segmenter", "none", "--calibrate", "off", "--quiet", "--silence", "300")
    code = main(["live", f"ros2:{DOMAIN + 4}", "--out", str(out), "--max-frames", str(2 * FRAMES),
                 "--odometry-topic", "/odom", "--reliable", *options])  # fmt: skip
    ended.set()
    players[-1].communicate(timeout=60)
    playing.join(60)
    assert code == 0
    assert [player.returncode for player in players] == [-signal.SIGKILL, 0]
    odometry = json.loads((tmp_path / "again").read_text())["/bmask_slam/odometry"]
    assert len(odometry) >= 3
    assert all(one["stamp_s"] >= BEGIN_S + again / 30 for one in odometry)
    check_poses(odometry)
    saved = np.loadtxt(out / "trajectory.txt", ndmin=2)[:, 0]
    assert saved.min() < BEGIN_S + 1 < BEGIN_S + again / 30 <= saved.max()
