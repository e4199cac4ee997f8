"""A second process on a DDS domain: plays a moving camera before a plane, and keeps what it hears.

Arguments: domain, rate in Hz, file for the received messages (JSON). Frames that are dropped do not
matter: the camera goes to and fro until nobody listens any more.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
from synthetic_view import CAMERA, render_plane

from bmask_slam.graph.geometry import se3_exp
from bmask_slam.live.ros2.dds import LATCHED, SENSOR, STATE, Node
from bmask_slam.live.ros2.outputs import header, type_name, typestore

COLOUR, DEPTH = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/camera/color/camera_info"
HEARD = {
    "/bmask_slam/odometry": ("Odometry", STATE),
    "/bmask_slam/pose": ("PoseWithCovarianceStamped", STATE),
    "/bmask_slam/path": ("Path", LATCHED),
    "/bmask_slam/landmarks": ("PointCloud2", LATCHED),
    "/diagnostics": ("DiagnosticArray", STATE),
    "/tf": ("TFMessage", STATE),
    "/tf_static": ("TFMessage", LATCHED),
}
BEGIN_S = 1000.0
LONGEST_S = 120.0
PLACES = 10


def place(k: int) -> int:
    """Which of the PLACES frame k is taken from, to and fro."""
    return abs((k + PLACES - 1) % (2 * PLACES - 2) - (PLACES - 1))


def pose(k: int) -> np.ndarray:
    """T_world_camera of a frame: sideways, and a turn."""
    return se3_exp(place(k) * np.array([0, 0.01, 0, 0.02, 0, 0]))


def image(stamp_s: float, encoding: str, pixels: np.ndarray) -> object:
    """A sensor_msgs/Image."""
    kind = typestore().types["sensor_msgs/msg/Image"]
    height, width = pixels.shape[:2]
    data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    step = len(data) // height
    return kind(header(stamp_s, "camera"), height, width, encoding, 0, step, data)


def info(stamp_s: float) -> object:
    """A sensor_msgs/CameraInfo of the camera."""
    types = typestore().types
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    p = np.hstack([CAMERA.K, np.zeros((3, 1))]).ravel()
    return types["sensor_msgs/msg/CameraInfo"](
        header(stamp_s, "camera"), CAMERA.height, CAMERA.width, "plumb_bob", np.zeros(5),
        CAMERA.K.ravel(), np.eye(3).ravel(), p, 0, 0, roi,
    )  # fmt: skip


def main() -> None:
    """Play frames until nothing has come for four seconds since the first pose."""
    domain, rate_hz, out = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    node = Node(domain)
    image_type = "sensor_msgs/msg/Image"
    colours = node.writer(COLOUR, image_type, SENSOR._replace(reliable=True))
    depths = node.writer(DEPTH, image_type, SENSOR._replace(reliable=True))
    infos = node.writer(INFO, "sensor_msgs/msg/CameraInfo", SENSOR._replace(reliable=True))
    readers = {t: node.reader(t, type_name(k), q) for t, (k, q) in HEARD.items()}
    heard: dict[str, list] = {topic: [] for topic in HEARD}
    rendered = [render_plane(pose(k), k) for k in range(PLACES)]
    k, last_s = 0, time.monotonic()
    end_s = last_s + LONGEST_S
    while time.monotonic() < min(last_s + 4, end_s):
        for topic, reader in readers.items():
            for received in reader.take():
                heard[topic].append(told(received))
                last_s = time.monotonic()
        stamp_s, frame = BEGIN_S + k / 30, rendered[place(k)]
        infos.send(info(stamp_s))
        colours.send(image(stamp_s, "rgb8", frame.rgb))
        depths.send(image(stamp_s, "32FC1", frame.depth_m.astype(np.float32)))
        if heard["/tf"]:
            k += 1
        else:  # the first is repeated until somebody tracks: a camera is there before
            last_s = time.monotonic()
        time.sleep(1 / rate_hz)
    Path(out).write_text(json.dumps(heard))


def told(received: object) -> dict:
    """What the test asks of a message."""
    name = type(received).__name__.rpartition("__")[2]
    if name == "Odometry":
        p, q = received.pose.pose.position, received.pose.pose.orientation
        stamp = received.header.stamp
        return {
            "stamp_s": stamp.sec + 1e-9 * stamp.nanosec, "position": [p.x, p.y, p.z],
            "quaternion": [q.x, q.y, q.z, q.w], "frame": received.header.frame_id,
            "child": received.child_frame_id,
        }  # fmt: skip
    if name == "TFMessage":
        return {"links": [[t.header.frame_id, t.child_frame_id] for t in received.transforms]}
    if name == "PointCloud2":
        return {"points": received.width, "fields": [f.name for f in received.fields]}
    if name == "DiagnosticArray":
        return {"status": received.status[0].message}
    if name == "Path":
        return {"poses": len(received.poses)}
    return {"name": name}


if __name__ == "__main__":
    main()
