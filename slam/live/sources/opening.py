"""Open the source that a name on the command line stands for."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, fields
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.live.ros2.dds import DdsNode
from bmask_slam.live.ros2.transport import Node
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.cameras.azure_camera import AzureSource
from bmask_slam.live.sources.cameras.oak_camera import OakSource
from bmask_slam.live.sources.cameras.opencv_camera import OpenCvSource
from bmask_slam.live.sources.cameras.realsense_camera import RealSenseSource
from bmask_slam.live.sources.cameras.record3d_camera import Record3dSource
from bmask_slam.live.sources.growing_folder import FollowOptions, GrowingFolder
from bmask_slam.live.sources.recorded_source import RecordedSource
from bmask_slam.live.sources.ros2_source import Ros2Options, Ros2Source
from bmask_slam.live.sources.source import Limited, Reduced, Source, Wrapped
from bmask_slam.sequences.bags.bag_file import is_bag
from bmask_slam.sequences.bags.sensors import SensorTopics
from bmask_slam.sequences.bags.topics import BagTopics
from bmask_slam.sequences.formats.layouts import is_recording_file
from bmask_slam.sequences.images import working_camera
from bmask_slam.sequences.sequence import open_sequence

REALSENSE, OAK, OPENCV, ROS2 = "realsense:", "oak:", "opencv:", "ros2:"
AZURE, RECORD3D = "azure:", "record3d:"


@dataclass(frozen=True)
class SourceOptions:
    """How a source is read; each kind of source uses the options that apply to it.

    Attributes:
        camera: camera file in place of the source's own camera.
        realtime: play a recording at the rate of its stamps.
        max_frames: end after so many frames.
        follow: the folder is still being written.
        silence_s: such a folder, or a camera, has ended when nothing new comes for so long.
        topics: of a bag, or of ROS 2.
        reliable: ROS 2 sends images again that are lost.
        sensors: topics of ROS 2.
        node: takes part in ROS 2, in place of one of DDS.
        full_size: large images are not reduced.
    """

    camera: Path | None = None
    realtime: bool = False
    max_frames: int | None = None
    follow: bool = False
    silence_s: float = 10.0
    topics: BagTopics = field(default_factory=BagTopics)
    reliable: bool = False
    sensors: SensorTopics = field(default_factory=SensorTopics)
    node: Node | None = None
    full_size: bool = False

    def __post_init__(self) -> None:
        if self.max_frames is not None and self.max_frames < 1:
            wrong = f"--max-frames {self.max_frames}"
            raise InputError(f"{wrong}: must be a whole number of at least 1")
        if not self.silence_s > 0:
            raise InputError(f"--silence {self.silence_s:g}: must be more than 0 seconds")


def open_source(text: str, options: SourceOptions) -> Source:
    """Open a recording in any layout, a bag, a camera by its name, or ROS 2.

    Raises:
        InputError: the name is none of these, or the source cannot be opened.
    """
    path = Path(text)
    source: Source
    if (camera := _camera(text, options)) is not None:
        source = camera
    elif text.startswith(ROS2):
        domain = _domain(text)
        node = options.node or DdsNode(domain)
        source = Ros2Source(node, f"{ROS2}{domain}", _of_ros2(options))
    elif is_bag(path):
        source = BagSource(path, options.topics, options.camera, options.realtime)
    elif options.follow:
        follow = FollowOptions(silence_s=options.silence_s)
        source = GrowingFolder(path, options.camera, follow)
    elif path.is_dir() or is_recording_file(path):
        given = options.topics.of_path(path)
        sequence = open_sequence(given, camera=options.camera, full_size=options.full_size)
        source = RecordedSource(sequence, options.realtime)
    else:
        raise InputError(
            f"{text}: not a source; give a recording, a .bag, a bag folder, a .mcap, "
            "realsense:, oak:, azure:, opencv:N, record3d: or ros2:"
        )
    if not options.full_size and working_camera(source.camera) != source.camera:
        source = Reduced(source)
    return source if options.max_frames is None else Limited(source, options.max_frames)


def ros2_of(source: Source) -> Ros2Source | None:
    """The source, also of a limited or reduced one, if it is ROS 2."""
    inner = source
    while isinstance(inner, Wrapped):
        inner = inner.source
    return inner if isinstance(inner, Ros2Source) else None


def _of_ros2(options: SourceOptions) -> Ros2Options:
    names = [f.name for f in fields(Ros2Options)]
    return Ros2Options(**{name: getattr(options, name) for name in names})


def _domain(text: str) -> int:
    """The DDS domain of ros2:N; ros2: is that of ROS_DOMAIN_ID, or 0."""
    number = text.removeprefix(ROS2) or os.environ.get("ROS_DOMAIN_ID", "0")
    if not (number.isdecimal() and len(number) < 4):
        raise InputError(f"{text}: {number!r} is no domain of ROS 2; write e.g. ros2:0")
    return int(number)


def _camera(text: str, options: SourceOptions) -> Source | None:
    """The camera that is plugged in, by its name; None if it is no name of one."""
    prefix, colon, number = text.partition(":")
    given = options.camera, options.silence_s
    if f"{prefix}{colon}" == REALSENSE:
        return RealSenseSource(*given, recording=Path(number) if number else None)
    if text == OAK:
        return OakSource(*given)
    kinds = {OPENCV: OpenCvSource, AZURE: AzureSource, RECORD3D: Record3dSource}
    kind = kinds.get(f"{prefix}{colon}")
    return None if kind is None else kind(_device(text, number), *given)


def _device(text: str, number: str) -> int:
    """The number of a device; of none the first."""
    if not (number or "0").isdecimal():
        prefix = text.partition(":")[0]
        raise InputError(f"{text}: not the number of a device; write e.g. {prefix}:0")
    return int(number or 0)
