"""A second process on a DDS domain: plays a moving camera before a plane, and keeps what it hears.

Services are called one after the other, each after the answer of the one before. Frames that are
dropped do not matter: the camera goes to and fro until standard input is closed, a step for each
odometry that is heard, or every PATIENCE ticks.

Until the first is heard, few colour images have a depth image of their time. Frames that wait
while a live run starts would be more than it has time for, and it would drop them. A camera that is
started again (--first) plays to a run that has started.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from ros2_messages import HEARD, told
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.geometry import inverse, make_pose, rotation_from_quaternion, se3_exp
from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.messages import header, message, transform, type_name
from bmask_slam.live.ros2.messages import pose as ros_pose
from bmask_slam.live.ros2.transport import LATCHED, SENSOR, STATE, typestore

COLOUR, DEPTH = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO, WHEELS = "/camera/camera/color/camera_info", "/odom"
T_BASE_CAMERA = make_pose(
    rotation_from_quaternion(np.array([0.4, -0.5, 0.6, -0.5])), np.array([0.3, 0.1, 0.9])
)
T_ODOM_MAP = se3_exp(np.array([0, 0, 0.7, 3.0, -2.0, 0]))
BEGIN_S = 1000.0
LONGEST_S, QUIET_S = 400.0, 2.0
"""Of playing; and of silence after it, when all is received that was sent."""
PLACES, WAITING, PATIENCE = 10, 9000, 25
"""The camera's places; ticks that it has for waiting at the first; those of which one has a frame
until odometry is heard, so that none waits in a queue of ten images with another."""


def place(k: int) -> int:
    """Which of the PLACES frame k is taken from, to and fro; the first as long as k < 0."""
    k = max(k, 0)
    return abs((k + PLACES - 1) % (2 * PLACES - 2) - (PLACES - 1))


def pose(k: int) -> np.ndarray:
    """T_world_camera of a frame: sideways, and a turn."""
    return se3_exp(place(k) * np.array([0, 0.01, 0, 0.02, 0, 0]))


def T_odom_base(k: int) -> np.ndarray:
    """Where the wheels say the base is, at a frame's time, in a frame of their own."""
    T = inverse(pose(0)) @ pose(k)
    return T_ODOM_MAP @ T_BASE_CAMERA @ T @ inverse(T_BASE_CAMERA)


def wheels(k: int) -> object:
    """The same as nav_msgs/Odometry."""
    zero = message("Vector3", 0.0, 0.0, 0.0)
    twist = message("TwistWithCovariance", message("Twist", zero, zero), np.zeros(36))
    known = message("PoseWithCovariance", ros_pose(T_odom_base(k)), np.zeros(36))
    return message("Odometry", header(BEGIN_S + k / 30, "odom"), "base_link", known, twist)


def image(stamp_s: float, encoding: str, pixels: np.ndarray) -> object:
    """A sensor_msgs/Image."""
    kind = typestore().types["sensor_msgs/msg/Image"]
    height, width = pixels.shape[:2]
    data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    step = len(data) // height
    return kind(header(stamp_s, "camera"), height, width, encoding, 0, step, data)


def compressed_colour(stamp_s: float, rgb: np.ndarray) -> object:
    """A sensor_msgs/CompressedImage as image_transport makes it."""
    return _compressed(stamp_s, "rgb8; jpeg compressed bgr8", ".jpg", rgb[..., ::-1], b"")


def compressed_depth(stamp_s: float, depth_m: np.ndarray) -> object:
    """The same of depth, in millimetres, with the twelve bytes of a header that it puts first."""
    stored = np.nan_to_num(np.round(1e3 * depth_m)).astype(np.uint16)
    return _compressed(stamp_s, "16UC1; compressedDepth png", ".png", stored, bytes(12))


def _compressed(stamp_s: float, form: str, suffix: str, pixels: np.ndarray, head: bytes) -> object:
    encoded = cv2.imencode(suffix, np.ascontiguousarray(pixels))[1].tobytes()
    data = np.frombuffer(head + encoded, np.uint8)
    return message("CompressedImage", header(stamp_s, "camera"), form, data)


def info(stamp_s: float) -> object:
    """A sensor_msgs/CameraInfo of the camera."""
    types = typestore().types
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    p = np.hstack([CAMERA.K, np.zeros((3, 1))]).ravel()
    return types["sensor_msgs/msg/CameraInfo"](
        header(stamp_s, "camera"), CAMERA.height, CAMERA.width, "plumb_bob", np.zeros(5),
        CAMERA.K.ravel(), np.eye(3).ravel(), p, 0, 0, roi,
    )  # fmt: skip


class Caller:
    """Calls services of bmask-slam one after the other; ``answers`` are as they came."""

    def __init__(self, node: DdsNode, calls: list[str]) -> None:
        self.answers: list[dict] = []
        self._calls = [call.split("=") for call in calls]
        kinds = {name: "SetBool" if value else "Trigger" for name, *value in self._calls}
        self._clients = {
            name: (node.service(f"/bmask_slam/{name}", f"std_srvs/srv/{kind}", calls=True), kind)
            for name, kind in kinds.items()
        }
        self._waits = False

    def step(self, frame: int) -> None:
        """Call the next, or take an answer."""
        if self._waits:
            name = self._calls[0][0]
            for answer in self._clients[name][0].take():
                message, self._waits = answer.message, False
                told = {"success": message.success, "text": message.message, "frame": frame}
                self.answers.append({"name": name} | told)
            if not self._waits:
                self._calls.pop(0)
        elif self._calls:
            name, *value = self._calls[0]
            client, kind = self._clients[name]
            request = typestore().types[f"std_srvs/srv/{kind}_Request"]
            client.send(request(bool(value and value[0] == "on")), bytes(range(16)))
            self._waits = True


def parsed(words: list[str]) -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser()
    parser.add_argument("domain", type=int)
    parser.add_argument("rate_hz", type=float)
    parser.add_argument("out", type=Path, help="file for the received messages, JSON by topic")
    parser.add_argument("calls", nargs="*", help="services to call, such as save_map")
    parser.add_argument("--first", type=int, default=0, help="the first frame, without waiting")
    parser.add_argument("--die-after", type=int, default=0, help="odometry messages until SIGKILL")
    parser.add_argument("--tf", action="store_true", help="wheels by /tf in place of a topic")
    return parser.parse_args(words)


class Player:
    """A camera and wheels that publish; with ``by_tf`` the wheels by /tf alone.

    Attributes:
        rendered: the camera's frames, by place.
    """

    def __init__(self, node: DdsNode, compressed: bool = False, by_tf: bool = False) -> None:
        quality = SENSOR._replace(reliable=True)
        kind = type_name("CompressedImage" if compressed else "Image")
        forms = ("/compressed", "/compressedDepth") if compressed else ("", "")
        self._colours = node.writer(f"{COLOUR}{forms[0]}", kind, quality)
        self._depths = node.writer(f"{DEPTH}{forms[1]}", kind, quality)
        self._infos = node.writer(INFO, "sensor_msgs/msg/CameraInfo", quality)
        self._by_tf = by_tf
        wheels_topic = ("/tf", "TFMessage", STATE) if by_tf else (WHEELS, "Odometry", quality)
        self._odometry = node.writer(wheels_topic[0], type_name(wheels_topic[1]), wheels_topic[2])
        self._static = node.writer("/tf_static", type_name("TFMessage"), LATCHED)
        link = transform(0.0, ("base_link", "camera"), T_BASE_CAMERA)
        self._static.send(message("TFMessage", [link]))
        self._compressed = compressed
        self.rendered = [render_plane(pose(k), k) for k in range(PLACES)]

    def play(self, k: int, rgb: bool = True, depth: bool = True) -> None:
        """Send a frame, or one of its images, and where the wheels are."""
        stamp_s, frame = BEGIN_S + k / 30, self.rendered[place(k)]
        self._infos.send(info(stamp_s))
        link = transform(stamp_s, ("odom", "base_link"), T_odom_base(k))
        self._odometry.send(message("TFMessage", [link]) if self._by_tf else wheels(k))
        if rgb:
            raw = image(stamp_s, "rgb8", frame.rgb)
            self._colours.send(compressed_colour(stamp_s, frame.rgb) if self._compressed else raw)
        if depth:
            raw = image(stamp_s, "32FC1", frame.depth_m.astype(np.float32))
            self._depths.send(compressed_depth(stamp_s, frame.depth_m) if self._compressed else raw)


def main() -> None:
    """Play frames until standard input is closed."""
    options = parsed(sys.argv[1:])
    node = DdsNode(options.domain)
    player, caller = Player(node, by_tf=options.tf), Caller(node, options.calls)
    readers = {t: node.reader(t, type_name(k), q) for t, (k, q) in HEARD.items()}
    heard: dict[str, list] = {topic: [] for topic in HEARD}

    def hear() -> bool:
        """Take what has come; whether anything has."""
        found = {topic: list(map(told, reader.take())) for topic, reader in readers.items()}
        for topic, messages in found.items():
            heard[topic] += messages
        return any(found.values())

    k = options.first or -WAITING
    idle, known, end_s = 0, 0, time.monotonic() + LONGEST_S
    while not select.select([sys.stdin], [], [], 0)[0] and time.monotonic() < end_s:
        hear()
        poses = heard["/bmask_slam/odometry"]
        if options.die_after and len(poses) >= options.die_after:
            os.kill(os.getpid(), signal.SIGKILL)
        waits = not node.published().keys() >= HEARD.keys()  # what is tracked would go unheard
        if not waits and (len(poses) > known or idle >= PATIENCE):
            k = max(k, 0) if poses else k
            player.play(k)
            k, idle, known = k + 1, 0, len(poses)
        elif not poses and not options.first:
            player.play(k, rgb=k % 2 == 0, depth=k % 2 == 1)
            k += 1
        if poses:
            caller.step(k)
        idle += 1
        time.sleep(1 / options.rate_hz)
    quiet_s = time.monotonic()
    while time.monotonic() < quiet_s + QUIET_S:
        quiet_s = time.monotonic() if hear() else quiet_s
        time.sleep(0.02)
    options.out.write_text(json.dumps(heard | {"answers": caller.answers}))


if __name__ == "__main__":
    main()
