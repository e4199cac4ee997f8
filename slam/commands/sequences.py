"""``bmask-slam render``, ``info`` and ``download``: sequences, made, described and fetched."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from shlex import quote

from bmask_slam.commands.arguments import (
    Commands,
    add_camera_argument,
    add_output_arguments,
    add_topic_arguments,
    bag_topics,
    print_result,
)

CONVERT_MORE = """\
Depth is registered to colour where the recording has it otherwise; colour that is a file of its own
is copied as it is. docs/data.md has the layouts."""
DOWNLOAD = "fetch published recordings (TUM, Bonn, ICL-NUIM) from where they were published"
DOWNLOAD_MORE = """\
A download that was interrupted goes on where it stopped. Size and SHA-256 are checked where they
are known; where they are not, those of the first download are kept in DIR/SHA256SUMS, and later
ones must agree. compare finds the recordings in DIR by --data DIR."""


def add_render(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "render an indoor sequence with exact ground truth, in TUM layout"
    parser = commands.add_parser("render", help=text, description=text)
    parser.set_defaults(handler=_render)
    scenes = "office, busy_office, crowded_office, living_room, corridor, building or room"
    parser.add_argument("name", help=scenes)
    parser.add_argument("--out", type=Path, required=True, help="folder to make")
    parser.add_argument("--frames", type=int, metavar="N", help="number of frames (default: all)")
    parser.add_argument(
        "--rounds", type=int, default=1, metavar="N", help="walk the corridor N times"
    )
    parser.add_argument("--fps", type=float, default=30.0, help="frame rate (default: 30)")
    parser.add_argument("--width", type=int, default=640, metavar="PX", help="default: 640")
    parser.add_argument("--height", type=int, default=480, metavar="PX", help="default: 480")
    parser.add_argument("--seed", type=int, default=0, help="of people, noise, textures, room")
    parser.add_argument("--people", type=int, default=0, metavar="N", help="people in the scene")
    parser.add_argument(
        "--carry", action="store_true", help="the first carries a box, pulls a chair"
    )
    parser.add_argument("--no-noise", action="store_true", help="exact depth and colours")
    parser.add_argument("--exposure-change", action="store_true", help="brightness that varies")
    parser.add_argument("--motion-blur", action="store_true", help="blur along the motion")
    parser.add_argument(
        "--depth-delay-ms", type=float, default=0.0, metavar="MS", help="depth taken so much later"
    )
    text = "rows exposed in turn over so long, the middle at the stamp"
    parser.add_argument("--rolling-shutter-ms", type=float, default=0.0, metavar="MS", help=text)
    parser.add_argument("--sweeping", action="store_true", help="tilt and roll, as to calibrate")
    text = (
        "also odometry,position,accelerometer,imu: files beside the images; markers: on the walls"
    )
    parser.add_argument("--sensors", default="", metavar="S,S", help=text)
    parser.add_argument("--true-depth", action="store_true", help="also write noise-free depth")
    parser.add_argument("--normals", action="store_true", help="also write surface normals")
    add_output_arguments(parser, "the folder's path")


def _render(arguments: argparse.Namespace) -> int:
    from bmask_slam.rendering.config import RenderConfig
    from bmask_slam.rendering.sequence import render_sequence
    from bmask_slam.runtime.progress import counting_bar

    names = (f.name for f in fields(RenderConfig) if f.name != "noise")
    given = {name: getattr(arguments, name) for name in names}
    given["sensors"] = tuple(filter(None, arguments.sensors.split(",")))
    config = RenderConfig(noise=not arguments.no_noise, **given)
    with counting_bar(arguments.quiet) as progress:
        folder = render_sequence(config, arguments.out, progress)
    text = f"Sequence {folder}; next: bmask-slam run {quote(str(folder))}"
    print_result(arguments, folder, lambda: text, {"sequence": folder})
    return 0


def add_info(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "say what a sequence holds: frames, camera, depth, ground truth; of a bag its topics"
    parser = commands.add_parser("info", help=text, description=text)
    parser.set_defaults(handler=_info)
    parser.add_argument("sequence", type=Path, help="recording, ROS bag, or run of one")
    add_camera_argument(parser)
    parser.add_argument("--json", action="store_true", help="print it as JSON")


def _info(arguments: argparse.Namespace) -> int:
    from bmask_slam.graph.files.json_file import format_json
    from bmask_slam.run_folder.origin import recording_of
    from bmask_slam.sequences.bags.bag_file import format_topics, is_bag, open_bag
    from bmask_slam.sequences.info import format_info, info_as_json, sequence_info
    from bmask_slam.sequences.sequence import open_sequence

    source, camera = recording_of(arguments.sequence), arguments.camera
    if is_bag(source):
        with open_bag(source) as bag:
            topics = {"duration_s": bag.duration_s, "topics": list(bag.topics)}
            print(format_json(topics) if arguments.json else format_topics(bag))
        return 0
    info = sequence_info(open_sequence(source, camera=camera, full_size=arguments.full_size))
    print(info_as_json(info) if arguments.json else format_info(info))
    return 0


def add_convert(commands: Commands) -> None:
    """Add the command to the parser."""
    text = "write a recording in another layout, or a ROS bag, as a folder in TUM layout"
    parser = commands.add_parser("convert", help=text, description=f"{text}. {CONVERT_MORE}")
    parser.set_defaults(handler=_convert)
    parser.add_argument("sequence", type=Path, metavar="A", help="recording, as run takes it")
    parser.add_argument("out", type=Path, metavar="B", help="folder to make")
    add_camera_argument(parser, of_copy=True)
    add_topic_arguments(parser)
    parser.add_argument("--max-frames", type=int, metavar="N", help="only the first N images")
    add_output_arguments(parser, "the folder's path")


def _convert(arguments: argparse.Namespace) -> int:
    from bmask_slam.runtime.progress import counting_bar
    from bmask_slam.sequences.formats.convert import convert

    source = bag_topics(arguments).of_path(arguments.sequence)
    with counting_bar(arguments.quiet) as progress:
        done = convert(source, arguments.out, arguments.camera, arguments.max_frames, progress)
    folder = arguments.out
    text = f"{done}\nSequence {folder}; next: bmask-slam run {quote(str(folder))}"
    print_result(arguments, folder, lambda: text, {"sequence": folder, **vars(done)})
    return 0


def add_download(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "download", help=DOWNLOAD, description=f"{DOWNLOAD}. {DOWNLOAD_MORE}"
    )
    parser.set_defaults(handler=_download)
    parser.add_argument("names", nargs="*", metavar="SEQUENCE", help="such as tum/freiburg1_xyz")
    parser.add_argument("--to", type=Path, default=Path("data"), metavar="DIR",
                        help="where sequences go, each to DIR/SET/NAME (data)")  # fmt: skip
    parser.add_argument("--list", action="store_true", help="name all sequences, with sizes")
    parser.add_argument("--keep-archive", action="store_true", help="do not remove the archive")
    parser.add_argument("--catalogue", type=Path, metavar="F", help="another list of sequences")
    add_output_arguments(parser, "the folders' paths")


def _download(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.catalogue import find, format_catalogue, read_catalogue
    from bmask_slam.datasets.obtain import obtain
    from bmask_slam.graph.errors import InputError
    from bmask_slam.graph.files.json_file import format_json
    from bmask_slam.runtime.progress import byte_bars

    catalogue = read_catalogue(arguments.catalogue)
    if arguments.list:
        known = list(catalogue.values())
        names = "\n".join(catalogue)
        told = {"recordings": known}
        print_result(arguments, names, lambda: format_catalogue(catalogue), told)
        return 0
    if not arguments.names:
        raise InputError("download: no sequence is named; --list names all")
    folders, found = [], [find(catalogue, name) for name in arguments.names]
    for recording in found:
        with byte_bars(arguments.quiet) as progress:
            folder = obtain(recording, arguments.to, progress, arguments.keep_archive)
        about = f"  ({recording.title}; {recording.licence}; {recording.page})"
        folders.append(folder)
        if not arguments.json:
            print(folder if arguments.quiet else f"Sequence {folder}{about}")
    if arguments.json:
        print(format_json({"sequences": folders, "recordings": found}))
    return 0
