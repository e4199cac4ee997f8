"""Frames from a ROS bag, read message by message."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.live.sources.bags import IMAGE_TYPES, INFO_TYPE, Bag, open_bag
from bmask_slam.live.sources.checks import check_depth_scale, check_sizes
from bmask_slam.live.sources.pairing import DEPTH, RGB, Pair, Pairer
from bmask_slam.live.sources.ros_images import (
    DEPTH_SCALES,
    camera_of,
    colour_image,
    depth_encoding,
    depth_image,
    stamp_s,
)
from bmask_slam.live.sources.source import SourceCounts, paced
from bmask_slam.sequences import read_camera
from bmask_slam.sequences.camera_presets import is_preset
from bmask_slam.sequences.cameras import given_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.images import depth_in_metres

logger = logging.getLogger(__name__)

_FIELDS = {
    INFO_TYPE: {"width", "height", "distortion_model", "d", "k", "p"},
    IMAGE_TYPES[0]: {"header", "encoding", "height", "width", "step", "is_bigendian", "data"},
    IMAGE_TYPES[1]: {"header", "format", "data"},
}


@dataclass(frozen=True)
class BagTopics:
    """Topics of a bag's images; by default those of the TUM RGB-D benchmark.

    Attributes:
        rgb, depth: topics of images, raw or compressed; depth registered to colour.
        camera_info: topic of the colour camera's intrinsics; empty: the ``camera_info`` beside the
            colour topic.
    """

    rgb: str = "/camera/rgb/image_color"
    depth: str = "/camera/depth/image"
    camera_info: str = ""


class BagSource:
    """A recorded bag; colour and depth are paired by the stamps in their headers.

    Attributes:
        counts: images that did not become frames so far.
        waits: see ``Source``; False if ``realtime``.
    """

    use = None

    def __init__(
        self,
        path: Path,
        topics: BagTopics | None = None,
        camera: Path | None = None,
        realtime: bool = False,
    ) -> None:
        """Find the topics and read the first message of each.

        Raises:
            InputError: a bag that cannot be read, a missing topic, messages that cannot be decoded
                as images, or no usable camera intrinsics.
        """
        self.name = path.resolve().stem
        self.groundtruth: Trajectory | None = None
        self.counts = SourceCounts()
        self.waits = not realtime
        self._path = path
        with open_bag(path) as bag:
            self._topics = find_topics(bag, topics or BagTopics())
            self.camera = _find_camera(bag, self._topics, camera)

    def frames(self) -> Iterator[Frame]:
        """A frame of each pair of images; what cannot be decoded is counted and skipped."""
        return self._frames() if self.waits else paced(self._frames())

    def close(self) -> None:
        """Nothing to release: ``frames`` opens and closes the bag."""

    def _frames(self) -> Iterator[Frame]:
        index = 0
        for pair in self._pairs():
            try:
                rgb = colour_image(pair.rgb, f"{self._topics.rgb} at {pair.stamp_s:.6f}")
                stored = depth_image(pair.depth, f"{self._topics.depth} at {pair.stamp_s:.6f}")
                check_sizes(rgb, stored, self.camera, f"{self._path} at {pair.stamp_s:.6f}")
            except InputError as error:
                self.counts.broken += 1
                logger.warning("skipped: %s", error)
                continue
            depth_m = depth_in_metres(stored, self.camera)
            yield Frame(index, pair.stamp_s, rgb, depth_m, depth_lag_s=pair.lag_s)
            index += 1

    def _pairs(self) -> Iterator[Pair[Any]]:
        pairer = Pairer[Any](self.counts, self.camera.depth_time_offset_s)
        with open_bag(self._path) as bag:
            for name, message in bag.messages(self._topics.rgb, self._topics.depth):
                stream = RGB if name == self._topics.rgb else DEPTH
                yield from pairer.add(stream, stamp_s(message.header), message)
        yield from pairer.finish()


def find_topics(bag: Bag, requested: BagTopics) -> BagTopics:
    """The topics' names in the bag; an image topic may exist in a compressed form only.

    Raises:
        InputError: a topic is missing or has no messages; the text lists the image topics.
    """
    found = {topic.name: topic.type for topic in bag.topics if topic.messages}
    images = [name for name, kind in found.items() if kind in IMAGE_TYPES]
    names = []
    for wish, option in ((requested.rgb, "--rgb-topic"), (requested.depth, "--depth-topic")):
        forms = [wish, f"{wish}/compressed", f"{wish}/compressedDepth"]
        available = [name for name in forms if name in images]
        if not available:
            raise InputError(
                f"{bag.path}: no images on {wish}; give {option}, one of: "
                f"{', '.join(images) or 'none, the bag has no images'}"
            )
        names.append(available[0])
    return BagTopics(names[0], names[1], requested.camera_info or _info_topic(requested.rgb))


def _info_topic(rgb: str) -> str:
    """The camera_info topic of an image topic, where image_transport puts it."""
    base = rgb.removesuffix("/compressed")
    return f"{base.rpartition('/')[0]}/camera_info"


def _find_camera(bag: Bag, topics: BagTopics, given: Path | None) -> Camera:
    """The given camera, or that of the camera_info; checked against the first images."""
    first = {name: _first(bag, name) for name in (topics.rgb, topics.depth)}
    rgb, depth = first[topics.rgb], first[topics.depth]
    scale = DEPTH_SCALES[depth_encoding(depth, topics.depth)]
    if given is not None and not is_preset(given):
        camera = read_camera(given)
        check_depth_scale(camera, scale, str(given), f"{bag.path}'s depth")
    else:
        rectified = "_rect" in topics.rgb.removesuffix("/compressed").rpartition("/")[2]
        where = f"{bag.path}: {topics.camera_info}"
        camera = camera_of(_camera_info(bag, topics.camera_info), scale, rectified, where)
        camera = camera if given is None else given_camera(given, camera)
    if rgb.header.frame_id != depth.header.frame_id:
        logger.warning(
            "%s: colour is in the frame %r, depth in %r; depth must be registered to colour",
            bag.path, rgb.header.frame_id, depth.header.frame_id,
        )  # fmt: skip
    images = colour_image(rgb, topics.rgb), depth_image(depth, topics.depth)
    check_sizes(*images, camera, f"{bag.path}: {topics.rgb} and {topics.depth}")
    return camera


def _camera_info(bag: Bag, name: str) -> Any:
    available = [topic.name for topic in bag.topics if topic.type == INFO_TYPE and topic.messages]
    if name not in available:
        raise InputError(
            f"{bag.path}: no camera_info on {name}; give --camera F or --camera-info-topic, one "
            f"of: {', '.join(available) or 'none'}"
        )
    return _first(bag, name)


def _first(bag: Bag, name: str) -> Any:
    """The first message of a topic, checked for the fields that are read later."""
    for _, message in bag.messages(name):
        missing = _FIELDS[message.__msgtype__] - {field.lower() for field in vars(message)}
        if missing:
            raise InputError(f"{bag.path}: {name} has no {', '.join(sorted(missing))}")
        return message
    raise InputError(f"{bag.path}: no message on {name}, though its index says so; it is damaged")
