"""``bmask-slam live``: the live loop on a source of frames."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bmask_slam.commands.arguments import (
    Commands,
    add_camera_argument,
    add_config_arguments,
    add_mesh_voxel_argument,
    add_output_arguments,
    add_segmenter_arguments,
    add_topic_arguments,
    add_view_arguments,
    bag_topics,
    camera_lines,
    chosen_config,
    format_summary,
    print_result,
    view_options,
)
from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.graph.sensors.streams import Measurements
    from bmask_slam.live.live_slam import LiveOptions, LiveSlam
    from bmask_slam.live.network.workstation import Workstation
    from bmask_slam.live.sources.opening import SourceOptions
    from bmask_slam.live.sources.source import Source
    from bmask_slam.system_config import SystemConfig

TEXT = "track a source of frames as they come"
MORE = """\
Tracking is here; the map with its graph and loops, segmentation and the dense map have processes
of their own. The run folder is that of `run`, with health.json, which is rewritten every second."""
WORKSTATION = """\
Has the map and makes the masks for robots that run `bmask-slam live SOURCE --workstation HOST`.
Only who knows the token is served, and can then run code here. What is sent is not encrypted."""
SENSORS = ("imu", "odometry", "position", "accelerometer")
SOURCE_HELP = """\
recording in any layout of docs/data.md, ROS 1 .bag, ROS 2 bag folder, .mcap; a camera that is
plugged in: realsense:, oak:, azure:, record3d:, opencv:N (device N of OpenNI 2); or ros2:
(ros2:DOMAIN)"""


def add_live(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("live", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_live, ros2_node=None)  # a program with a node of its own sets it
    parser.add_argument("source", metavar="SOURCE", help=SOURCE_HELP)
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<source>, numbered)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that --out holds")
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="play a recording at its own speed, dropping frames that there is no time for",
    )
    _add_source_arguments(parser)
    text = "machine that has the map and makes the masks: bmask-slam workstation runs there"
    parser.add_argument("--workstation", metavar="HOST[:PORT]", help=text)
    _add_token_argument(parser)
    add_config_arguments(parser)
    add_camera_argument(parser)
    text = "find readout, depth delay and bend while it runs; auto, the default: use them"
    parser.add_argument("--calibrate", default="auto", metavar="auto|off|report", help=text)
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")
    parser.add_argument("--map", action="store_true", help="also a dense map, as by bmask-slam map")
    add_mesh_voxel_argument(parser)
    text = "with --map: at most N frames a second between keyframes go into it (default: 5)"
    parser.add_argument("--map-frames", type=float, metavar="N", help=text)
    add_segmenter_arguments(parser, "light")
    parser.add_argument("--view", action="store_true", help="show it in Rerun's window")
    add_view_arguments(parser)
    add_output_arguments(parser, "the run folder's path")


def add_workstation(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "workstation",
        help="have map and masks for a robot that runs live --workstation",
        description=WORKSTATION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(handler=_workstation)
    text = "address to listen on (default: 127.0.0.1, for this machine only)"
    parser.add_argument("--host", default="127.0.0.1", help=text)
    parser.add_argument("--port", type=int, default=7717, help="(default: 7717)")
    _add_token_argument(parser)


def _add_token_argument(parser: argparse.ArgumentParser) -> None:
    text = "secret that robot and workstation share (default: ~/.config/bmask-slam/token)"
    parser.add_argument("--token-file", type=Path, metavar="F", help=text)


def _workstation(arguments: argparse.Namespace) -> int:
    from bmask_slam.live.network.connection import default_token_file, make_token, read_token
    from bmask_slam.live.network.server import WorkstationServer
    from bmask_slam.runtime.stop_request import StopRequest

    if not 0 <= arguments.port < 1 << 16:
        raise InputError(f"--port {arguments.port}: give one from 0, any that is free, to 65535")
    path = arguments.token_file or default_token_file()
    if not path.exists():
        make_token(path)
        print(f"a new token is in {path}; copy it to the robot", file=sys.stderr)
    server = WorkstationServer(arguments.host, arguments.port, read_token(path))
    print(f"listening on {arguments.host}:{server.port}; Ctrl-C ends it", flush=True)
    with closing(server), StopRequest() as stop:
        server.serve(lambda: stop.signal is not None)
    return 128 + stop.signal if stop.signal else 0


def _add_source_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--follow", action="store_true", help="the folder is still being written")
    parser.add_argument(
        "--silence",
        type=float,
        default=10.0,
        metavar="S",
        help="end when a folder that is followed, or a camera, gives nothing for S s (default: 10)",
    )
    add_topic_arguments(parser)
    for sensor in SENSORS:
        text = f"of a bag or ros2: {sensor}, with its sensors.{sensor} settings (default: none)"
        parser.add_argument(f"--{sensor}-topic", metavar="T", default="", help=text)
    text = "of ros2: frames, topics and the camera's place on the robot, as YAML"
    parser.add_argument("--ros2-params", type=Path, metavar="F", help=text)
    text = "of ros2: ask for images that are lost again"
    parser.add_argument("--reliable", action="store_true", help=text)


def source_options(arguments: argparse.Namespace) -> SourceOptions:
    """How the source is to be read."""
    from bmask_slam.live.sources.opening import ROS2, SourceOptions
    from bmask_slam.sequences.bags.sensors import SensorTopics

    sensors = SensorTopics()
    if arguments.source.startswith(ROS2):
        sensors = SensorTopics(**_sensor_topics(arguments))
    return SourceOptions(
        camera=arguments.camera,
        full_size=bool(arguments.full_size),
        realtime=arguments.realtime,
        max_frames=arguments.max_frames,
        follow=arguments.follow,
        silence_s=arguments.silence,
        topics=bag_topics(arguments),
        reliable=arguments.reliable,
        sensors=sensors,
        node=arguments.ros2_node,
    )


def _sensor_topics(arguments: argparse.Namespace) -> dict[str, str]:
    return {sensor: getattr(arguments, f"{sensor}_topic") for sensor in SENSORS}


def _live(arguments: argparse.Namespace) -> int:
    from bmask_slam.parallel.loading_ahead import load_workers

    load_workers()  # before what follows is imported
    from bmask_slam.live.sources.opening import open_source

    with closing(open_source(arguments.source, source_options(arguments))) as source:
        return _live_on(arguments, source)


def _live_on(arguments: argparse.Namespace, source: Source) -> int:
    """The command on a source that is open: one run, over ROS 2 others when that is asked for."""
    from bmask_slam.live.live_slam import LiveSlam
    from bmask_slam.live.play import PlayOptions, finishing, play, ros2_ends
    from bmask_slam.live.sources.opening import ros2_of

    config = chosen_config(arguments).config
    options, ros2 = _live_options(arguments, source), ros2_of(source)
    listener, services = None, None
    if ros2 is not None:
        config, listener, services = ros2_ends(ros2, arguments.ros2_params, config)
    before: Path | None = None
    while True:
        with finishing(LiveSlam(source.camera, config, options), listener, services) as slam:
            slam.source_counts = source.counts
            if ros2 is not None:
                ros2.deliver = slam.add_measurements
            for measured in measured_beside(arguments, options.images, config):
                slam.add_measurements(measured)
            sys.stderr.writelines(f"{address}\n" for address in slam.viewer_addresses)
            if services is not None and services.reset_asked:
                services.begin(before, slam.out)
            told = PlayOptions(not source.waits, quiet=arguments.quiet)
            ended_by = play(slam, source, told, listener, services)
        if ended_by or services is None or not services.reset_asked:
            if services is not None:
                services.end(slam.out)
            return _tell(arguments, slam, source, ended_by)
        before, options = slam.out, _next_run(options)


def _next_run(options: LiveOptions) -> LiveOptions:
    """Those of a run that begins where another has ended: with a folder of its own."""
    from bmask_slam.run_folder.open_files import free_run_path

    assert options.out is not None
    out = free_run_path(options.out.name, options.out.parent)
    return replace(options, out=out, overwrite=False)


def _tell(
    arguments: argparse.Namespace, slam: LiveSlam, source: Source, ended_by: int | None
) -> int:
    """Print what came of a run; returns the exit code."""
    found: dict[str, Any] = {"folder": slam.out, "calibration": slam.calibration}
    found |= {"source": source.counts.line(), "stopped_by": ended_by or None, "metrics": slam.rows}
    found |= {"dense_points": None if slam.dense is None else slam.dense.points}
    print_result(arguments, slam.out, lambda: _summary(slam, source), found)
    return 128 + ended_by if ended_by else 0


def measured_beside(
    arguments: argparse.Namespace, folder: Path | None, config: SystemConfig
) -> list[Measurements]:
    """What other sensors measured, from the files of a folder or the topics of a bag."""
    from bmask_slam.graph.sensors.streams import read_folder
    from bmask_slam.live.sources.opening import ROS2
    from bmask_slam.sequences.bags.bag_file import is_bag
    from bmask_slam.sequences.bags.sensors import SensorTopics, read_sensors

    if arguments.source.startswith(ROS2):
        return []  # they come as the frames do
    topics = _sensor_topics(arguments)
    given = [f"--{sensor}-topic" for sensor, topic in topics.items() if topic]
    path = Path(arguments.source)
    if given and not is_bag(path):
        raise InputError(f"{arguments.source}: no bag; leave {given[0]} out")
    if given:
        return read_sensors(path, SensorTopics(**topics))
    return read_folder(folder, config.sensors.enabled)


def _live_options(arguments: argparse.Namespace, source: Source) -> LiveOptions:
    """Where the run is written, and what the source says about itself."""
    from bmask_slam.live.live_slam import LiveOptions
    from bmask_slam.live.ros2.grid import POINTS
    from bmask_slam.live.sources.opening import ros2_of
    from bmask_slam.live.start import frames_a_second
    from bmask_slam.run_folder.open_files import free_run_path
    from bmask_slam.sequences.bags.bag_file import is_bag
    from bmask_slam.sequences.formats.layouts import is_recording_file

    path = Path(arguments.source)
    recording = path if path.is_dir() or is_recording_file(path) else None
    if is_bag(path):
        recording = bag_topics(arguments).of_path(path)
    return LiveOptions(
        full_size=arguments.full_size,
        out=arguments.out or free_run_path(f"{source.name}-live"),
        overwrite=arguments.overwrite,
        reference=source.groundtruth,
        view=view_options(arguments, arguments.view),
        images=recording,
        title=source.name,
        dense=arguments.map,
        mesh_voxel_m=arguments.mesh_voxel_m,
        surface_frames=frames_a_second(arguments.map_frames, arguments.map),
        submap_points=POINTS if ros2_of(source) is not None else 0,
        calibrate=arguments.calibrate,
        straightens=True,
        pairs=source.pairs,
        interpolates=source.interpolates,
        workstation=_workstation_of(arguments),
    )


def _workstation_of(arguments: argparse.Namespace) -> Workstation | None:
    from bmask_slam.live.network.workstation import Workstation

    if arguments.workstation is None:
        return None
    if arguments.ray:
        raise InputError("--ray: the masks are made on the workstation; leave one of both out")
    return Workstation.of(arguments.workstation, arguments.token_file)


def _summary(slam: LiveSlam, source: Source) -> str:
    lines = [format_summary(slam.rows), "", *camera_lines(slam.calibration, slam.out)]
    lines.append(f"Run folder  {slam.out}")
    if slam.dense is not None:
        made_of = f"{slam.dense.points} points, {slam.dense.frames} frames besides keyframes"
        lines.append(f"Dense map   {slam.out}/dense, {made_of}")
    if counts := source.counts.line():
        lines.append(f"Source      {counts}")
    return "\n".join(lines)
