"""ROS 2 without ROS: a second process plays a recording over DDS and hears what `live ros2:` says.

    python -m benchmarks.live.ros2 SEQUENCE [--frames 300] [--rate 30] [--kill-after 100] [-- --map]

Images are stamped when they are sent, so that the time of an answer less its stamp is the delay of
the whole way. With --kill-after the player is killed after so many frames and started again two
seconds later. What stands after -- goes to `bmask-slam live`. All on this machine (loop-back).
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.camera import Camera
from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.messages import header, type_name
from bmask_slam.live.ros2.transport import LATCHED, SENSOR, STATE, typestore
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.sequence import open_sequence

LOOPBACK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"
multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
COLOUR, DEPTH = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/camera/color/camera_info"
HEARD = {
    "/bmask_slam/odometry": ("Odometry", STATE._replace(depth=100)),
    "/bmask_slam/pose": ("PoseWithCovarianceStamped", STATE._replace(depth=100)),
    "/bmask_slam/path": ("Path", LATCHED),
    "/bmask_slam/landmarks": ("PointCloud2", LATCHED),
    "/bmask_slam/map": ("OccupancyGrid", LATCHED),
    "/bmask_slam/objects": ("Detection3DArray", LATCHED),
    "/bmask_slam/object_markers": ("MarkerArray", LATCHED),
    "/diagnostics": ("DiagnosticArray", STATE),
    "/tf": ("TFMessage", STATE._replace(depth=100)),
    "/tf_static": ("TFMessage", LATCHED),
}
PAUSE_S, QUIET_S, LONGEST_S = 2.0, 8.0, 900.0


def image(stamp: float, encoding: str, pixels: np.ndarray) -> Any:
    """A sensor_msgs/Image."""
    data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
    height, width = pixels.shape[:2]
    kind = typestore().types["sensor_msgs/msg/Image"]
    top = header(stamp, "camera_optical_frame")
    return kind(top, height, width, encoding, 0, len(data) // height, data)


def camera_info(stamp: float, camera: Camera) -> Any:
    """A sensor_msgs/CameraInfo."""
    types = typestore().types
    roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    p = np.hstack([camera.K, np.zeros((3, 1))]).ravel()
    return types["sensor_msgs/msg/CameraInfo"](
        header(stamp, "camera_optical_frame"), camera.height, camera.width, "plumb_bob",
        np.array(camera.distortion), camera.K.ravel(), np.eye(3).ravel(), p, 0, 0, roi,
    )  # fmt: skip


def play(path: Path, first: int, frames: int, rate_hz: float, domain: int) -> None:
    """Publish frames as a camera does; prints the stamp of each that is sent."""
    sequence, node, quality = open_sequence(path), DdsNode(domain), SENSOR._replace(reliable=True)
    colours, depths = (node.writer(t, type_name("Image"), quality) for t in (COLOUR, DEPTH))
    infos = node.writer(INFO, "sensor_msgs/msg/CameraInfo", LATCHED)
    infos.send(camera_info(time.time(), sequence.camera))
    due_s = time.monotonic()
    for frame in islice(sequence.frames(first), frames):
        time.sleep(max(due_s - time.monotonic(), 0))
        due_s += 1 / rate_hz
        now = time.time()
        colours.send(image(now, "rgb8", frame.rgb))
        depths.send(image(now, "32FC1", frame.depth_m.astype(np.float32)))
        print(f"{now:.6f}", flush=True)
    time.sleep(1)


class Player:
    """Starts processes that play, and collects the stamps that they sent."""

    def __init__(self, options: argparse.Namespace, domain: int) -> None:
        self.options, self.domain = options, domain
        self.sent: list[float] = []

    def run(self, first: int, frames: int) -> subprocess.Popen[str]:
        """Play some frames."""
        words = [
            sys.executable,
            "-m",
            "benchmarks.live.ros2",
            self.options.sequence,
            "--play",
            first,
            "--frames",
            frames,
            "--rate",
            self.options.rate,
            "--domain",
            self.domain,
        ]
        return subprocess.Popen(list(map(str, words)), stdout=subprocess.PIPE, text=True)

    def stop(self, process: subprocess.Popen[str], kill: bool) -> None:
        """Kill it, or wait for its end; the stamps are kept."""
        if kill:
            process.send_signal(signal.SIGKILL)
        output = process.communicate()[0]
        self.sent += [float(line) for line in output.splitlines() if line.strip()]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Play, hear, and return the figures."""
    os.environ.setdefault("CYCLONEDDS_URI", LOOPBACK)
    domain = options.domain or 100 + os.getpid() % 100
    out = options.out / f"ros2-{options.sequence.name}"
    command = [
        sys.executable,
        "-m",
        "bmask_slam",
        "live",
        f"ros2:{domain}",
        "--out",
        str(out),
        "--overwrite",
        "--quiet",
        "--silence",
        str(QUIET_S),
        *options.live,
    ]
    node, player = DdsNode(domain), Player(options, domain)
    readers = {topic: node.reader(topic, type_name(k), q) for topic, (k, q) in HEARD.items()}
    heard: dict[str, list[float]] = defaultdict(list)
    live = subprocess.Popen(command)
    end_s = time.monotonic() + LONGEST_S
    warm, parts = player.run(0, 10**6), [(0, options.frames)]
    while not heard["/tf_static"] and live.poll() is None and time.monotonic() < end_s:
        listen(readers, heard)  # the first frames are dropped while the processes start
    player.stop(warm, kill=True)
    if options.kill_after:
        parts = [(0, options.kill_after), (options.kill_after, options.frames - options.kill_after)]
    player.sent.clear()
    for k, (first, frames) in enumerate(parts):
        process = player.run(first, 10**6 if k + 1 < len(parts) else frames)
        begun = time.monotonic()
        while process.poll() is None and live.poll() is None and time.monotonic() < end_s:
            listen(readers, heard)
            if k + 1 < len(parts) and time.monotonic() - begun > 3 + frames / options.rate:
                break
        player.stop(process, kill=k + 1 < len(parts))
        time.sleep(PAUSE_S if k + 1 < len(parts) else 0)
    while live.poll() is None and time.monotonic() < end_s:
        listen(readers, heard)
    live.wait(10)
    return figures(player.sent, heard, json.loads((out / "health.json").read_text()), options)


def listen(readers: dict[str, Any], heard: dict[str, list[float]]) -> None:
    """Keep the delay of what has a stamp of an image, and count the rest."""
    for topic, reader in readers.items():
        for message in reader.take(100):
            known = hasattr(message, "header")
            stamp = stamp_s(message.header) if known else np.nan
            heard[topic].append(stamp)
            if topic == "/bmask_slam/odometry":
                heard["delays"].append(time.time() - stamp)
    time.sleep(0.002)


def figures(
    sent: list[float], heard: dict[str, list[float]], health: dict, options: argparse.Namespace
) -> dict[str, Any]:
    """What was lost and late, and how often each topic came."""
    answered = np.array(heard["/bmask_slam/odometry"])
    mine = [stamp for stamp in sent if len(answered) and np.abs(answered - stamp).min() < 1e-4]
    delays = [
        d for d, s in zip(heard["delays"], answered, strict=True) if sent and s >= min(sent) - 1e-4
    ]
    return {
        "sent": len(sent),
        "answered": len(mine),
        "late": int(sum(delay > 1 / options.rate for delay in delays)),
        "delay_ms": np.round(1e3 * np.percentile(delays, (50, 95, 100)), 1).tolist()
        if delays
        else [],
        "messages": {topic: len(heard[topic]) for topic in HEARD},
        "health": {
            name: health[name]
            for name in ("frames", "frames_dropped", "lost_frames", "latency_ms_median", "source")
        },
    }


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rate", type=float, default=30.0)
    parser.add_argument("--kill-after", type=int, default=0)
    parser.add_argument("--domain", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--play", type=int, metavar="FIRST", help="only play, from this frame on")
    words = sys.argv[1:]
    own, live = (
        (words[: words.index("--")], words[words.index("--") + 1 :])
        if "--" in words
        else (words, [])
    )
    options = parser.parse_args(own)
    options.live = live
    if options.play is not None:
        play(options.sequence, options.play, options.frames, options.rate, options.domain)
    else:
        print(json.dumps(measure(options), indent=1))


if __name__ == "__main__":
    main()
