"""Open the source that a name on the command line stands for."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.growing_folder import FollowOptions, GrowingFolder
from bmask_slam.live.sources.opencv_camera import OpenCvSource
from bmask_slam.live.sources.realsense_camera import RealSenseSource
from bmask_slam.live.sources.source import Limited, RecordedSource, Source
from bmask_slam.sequences import open_sequence
from bmask_slam.sequences.bags.bag_file import is_bag
from bmask_slam.sequences.bags.topics import BagTopics
from bmask_slam.sequences.formats.layouts import is_recording_file

REALSENSE, OPENCV = "realsense:", "opencv:"


@dataclass(frozen=True)
class SourceOptions:
    """How a source is read; each kind of source uses the options that apply to it.

    Attributes:
        camera: camera file in place of the source's own camera.
        realtime: play a recording at the rate of its stamps.
        max_frames: end after so many frames.
        follow: the folder is still being written.
        silence_s: such a folder, or a camera, has ended when nothing new comes for so long.
        topics: of a bag.
    """

    camera: Path | None = None
    realtime: bool = False
    max_frames: int | None = None
    follow: bool = False
    silence_s: float = 10.0
    topics: BagTopics = field(default_factory=BagTopics)


def open_source(text: str, options: SourceOptions) -> Source:
    """Open a recording in any layout, a bag, ``realsense:`` or ``opencv:N``.

    Raises:
        InputError: the name is none of these, or the source cannot be opened.
    """
    path = Path(text)
    source: Source
    if text == REALSENSE:
        source = RealSenseSource(options.camera, options.silence_s)
    elif text.startswith(OPENCV):
        source = OpenCvSource(_device(text), options.camera, options.silence_s)
    elif is_bag(path):
        source = BagSource(path, options.topics, options.camera, options.realtime)
    elif options.follow:
        follow = FollowOptions(silence_s=options.silence_s)
        source = GrowingFolder(path, options.camera, follow)
    elif path.is_dir() or is_recording_file(path):
        sequence = open_sequence(path, camera=options.camera)
        source = RecordedSource(sequence, options.realtime)
    else:
        raise InputError(
            f"{text}: not a source; give a recording, a .bag, a bag folder, a .mcap, "
            "realsense: or opencv:N"
        )
    return source if options.max_frames is None else Limited(source, options.max_frames)


def _device(text: str) -> int:
    number = text.removeprefix(OPENCV)
    if not number.isdecimal():
        raise InputError(f"{text}: not the number of a device; write e.g. opencv:0")
    return int(number)
