"""ROS 2 without ROS: a second process plays a recording over DDS and hears what `live ros2:` says.

    python -m benchmarks.live.ros2 SEQUENCE [--frames 300] [--rate 30] [--kill-after 100]
        [--make-bag BAG] [-- --map --reliable]

SEQUENCE is a recording or a bag, whose messages are played as they are but for their stamps; with
--make-bag a recording is written as a bag (mcap) first, and that is played. Images are stamped when
they are sent, so that the time of an answer less its stamp is the delay of the whole way. Until the
first answer comes, the first images are sent again and again. With --kill-after the player is
killed after so many frames and started again two seconds later. What stands after -- goes to
`bmask-slam live`. All on this machine (loop-back).
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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, repeat
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer

from bmask_slam.graph.camera import Camera
from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.messages import header, type_name
from bmask_slam.live.ros2.transport import LATCHED, SENSOR, STATE, typestore
from bmask_slam.live.sources.pairing import Pairer
from bmask_slam.live.sources.source import SourceCounts
from bmask_slam.sequences.bags.bag_file import INFO_TYPE, Bag, is_bag, open_bag
from bmask_slam.sequences.bags.ros_images import stamp_s
from bmask_slam.sequences.bags.topics import BagTopics, find_topics, first_message
from bmask_slam.sequences.bags.transforms import TRANSFORMS
from bmask_slam.sequences.sequence import open_sequence

LOOPBACK = """<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface name="lo"
multicast="false"/></Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery>
<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""
COLOUR, DEPTH = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO, IMAGE = "/camera/camera/color/camera_info", type_name("Image")
HEARD = {
    "/bmask_slam/odometry": ("Odometry", STATE._replace(depth=100)),
    "/bmask_slam/pose": ("PoseWithCovarianceStamped", STATE._replace(depth=100)),
    "/bmask_slam/path": ("Path", LATCHED),
    "/bmask_slam/landmarks": ("PointCloud2", LATCHED),
    "/bmask_slam/cloud": ("PointCloud2", LATCHED),
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


@dataclass(frozen=True)
class Images:
    """Pairs of messages to play, their topics and types, and what is sent once, latched."""

    topics: tuple[str, str]
    types: tuple[str, str]
    pairs: Iterator[tuple[Any, Any]]
    once: list[tuple[str, str, Any]]


@contextmanager
def open_images(path: Path, first: int) -> Iterator[Images]:
    """A recording or a bag from a frame on."""
    if not is_bag(path):
        sequence = open_sequence(path)
        pairs: Iterator[tuple[Any, Any]] = (
            (image(0.0, "rgb8", f.rgb), image(0.0, "32FC1", f.depth_m.astype(np.float32)))
            for f in sequence.frames(first)
        )
        known = [(INFO, INFO_TYPE, camera_info(0.0, sequence.camera))]
        yield Images((COLOUR, DEPTH), (IMAGE, IMAGE), pairs, known)
        return
    with open_bag(path) as bag:
        found, kinds = find_topics(bag, BagTopics()), {t.name: t.type for t in bag.topics}
        names = found.rgb, found.depth
        known = [(found.camera_info, INFO_TYPE, first_message(bag, found.camera_info))]
        for topic, still in islice(bag.messages(TRANSFORMS), 1):
            known.append((topic, kinds[topic], still))
        pairs = islice(bag_pairs(bag, names), first, None)
        yield Images(names, (kinds[names[0]], kinds[names[1]]), pairs, known)


def bag_pairs(bag: Bag, names: tuple[str, str]) -> Iterator[tuple[Any, Any]]:
    """Messages of colour and depth that belong together."""
    pairer = Pairer[Any](SourceCounts())
    for topic, received in bag.messages(*names):
        for pair in pairer.add(names.index(topic), stamp_s(received.header), received):
            yield pair.rgb, pair.depth
    for pair in pairer.finish():
        yield pair.rgb, pair.depth


def make_bag(path: Path, frames: int, folder: Path) -> None:
    """Write a recording as a ROS 2 bag (mcap), with the topics of RealSense and depth in mm."""
    sequence, store = open_sequence(path), typestore()
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        to = {
            topic: bag.add_connection(topic, kind, typestore=store)
            for topic, kind in ((COLOUR, IMAGE), (DEPTH, IMAGE), (INFO, INFO_TYPE))
        }
        for frame in islice(sequence.frames(), frames):
            at_s = frame.timestamp_s
            depth_mm = np.nan_to_num(np.round(1e3 * frame.depth_m)).astype(np.uint16)
            made = {COLOUR: image(at_s, "rgb8", frame.rgb), DEPTH: image(at_s, "16UC1", depth_mm)}
            made[INFO] = camera_info(at_s, sequence.camera)
            for topic, one in made.items():
                data = store.serialize_cdr(one, to[topic].msgtype)
                bag.write(to[topic], round(1e9 * at_s), data)


def play(options: argparse.Namespace) -> None:
    """Publish frames as a camera does; prints the stamp of each that is sent."""
    node, quality = DdsNode(options.domain), SENSOR._replace(reliable=True)
    with open_images(options.sequence, options.play) as images:
        kinds = zip(images.topics, images.types, strict=True)
        writers = [node.writer(topic, kind, quality) for topic, kind in kinds]
        latched = [(node.writer(topic, kind, LATCHED), one) for topic, kind, one in images.once]
        for writer, one in latched:
            writer.send(one)
        pairs = repeat(next(images.pairs)) if options.hold else images.pairs
        due_s = time.monotonic()
        for pair in islice(pairs, options.frames):
            time.sleep(max(due_s - time.monotonic(), 0))
            due_s += 1 / options.rate
            now = time.time()
            for writer, one in zip(writers, pair, strict=True):
                one.header = header(now, one.header.frame_id)
                writer.send(one)
            print(f"{now:.6f}", flush=True)
        time.sleep(1)


class Player:
    """Starts processes that play, and collects the stamps that they sent."""

    def __init__(self, options: argparse.Namespace, domain: int) -> None:
        self.options, self.domain = options, domain
        self.sent: list[float] = []

    def run(self, first: int, frames: int, *more: str) -> subprocess.Popen[str]:
        """Play some frames."""
        what = f"--play {first} --frames {frames} --rate {self.options.rate} --domain {self.domain}"
        words = [sys.executable, "-m", "benchmarks.live.ros2", str(self.options.sequence)]
        words += [*what.split(), *more]
        return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)

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
    command = [sys.executable, "-m", "bmask_slam", "live", f"ros2:{domain}", "--out", str(out)]
    command += ["--overwrite", "--quiet", "--silence", str(QUIET_S), *options.live]
    node, player = DdsNode(domain), Player(options, domain)
    readers = {topic: node.reader(topic, type_name(k), q) for topic, (k, q) in HEARD.items()}
    heard: dict[str, list[float]] = defaultdict(list)
    live = subprocess.Popen(command)
    end_s = time.monotonic() + LONGEST_S
    warm, parts = player.run(0, 10**6, "--hold"), [(0, options.frames)]
    while not heard["/bmask_slam/odometry"] and live.poll() is None and time.monotonic() < end_s:
        listen(readers, heard)
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
        "sent_hz": round(float(1 / np.median(np.diff(sent))), 1) if len(sent) > 1 else None,
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
    parser.add_argument("--hold", action="store_true", help="with --play: that frame all the time")
    parser.add_argument("--make-bag", type=Path, metavar="BAG", help="folder of a bag to make")
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    options = parser.parse_args(words[:cut])
    options.live = words[cut + 1 :]
    if options.play is not None:
        play(options)
    else:
        if options.make_bag:
            make_bag(options.sequence, options.frames, options.make_bag)
            options.sequence = options.make_bag
        print(json.dumps(measure(options), indent=1))


if __name__ == "__main__":
    main()
