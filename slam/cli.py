"""The command line. Each handler builds a configuration, calls one library function and prints.

Heavy modules are imported inside the handlers, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TypeAlias

from bmask_slam import __version__
from bmask_slam.commands.calibrate import add_calibrate
from bmask_slam.commands.compare import add_compare
from bmask_slam.commands.download import add_download
from bmask_slam.commands.evaluate_segmentation import add_evaluate_segmentation
from bmask_slam.commands.export import add_export
from bmask_slam.commands.live import add_live
from bmask_slam.commands.map import add_map
from bmask_slam.commands.optimise import add_optimise
from bmask_slam.commands.query import add_query
from bmask_slam.commands.run import add_run
from bmask_slam.commands.segment import add_segment
from bmask_slam.commands.train import add_train
from bmask_slam.commands.view import add_view
from bmask_slam.graph.errors import InputError

DESCRIPTION = "RGB-D SLAM on a GTSAM factor graph: a trajectory and a landmark map from a sequence."
EPILOG = """\
first steps:
  bmask-slam render office --frames 200 --out office   make a small sequence with exact truth
  bmask-slam run office                                run on it; results go to runs/office
  bmask-slam evaluate runs/office --reference office   compare a trajectory with a reference
"""
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, 1 for broken input, 2 for a wrong command line, and
    128 + signal when a signal ended it.
    """
    arguments = make_parser().parse_args(argv)
    try:
        return int(arguments.handler(arguments))
    except InputError as error:
        return _fail(str(error))
    except BrokenPipeError:  # `bmask-slam info ... | head`: nobody reads on
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except OSError as error:
        if error.errno not in DISK_ERRORS:
            raise
        return _fail(f"{error.filename or 'output'}: {error.strerror}; free some space")
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT


def _fail(message: str) -> int:
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return 1


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands; each stores its function as ``handler``."""
    parser = argparse.ArgumentParser(
        prog="bmask-slam",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"bmask-slam {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add_run(commands)
    add_live(commands)
    _add_evaluate(commands)
    _add_render(commands)
    _add_info(commands)
    add_download(commands)
    add_optimise(commands)
    add_export(commands)
    add_calibrate(commands)
    add_map(commands)
    add_query(commands)
    add_view(commands)
    add_segment(commands)
    add_train(commands)
    add_evaluate_segmentation(commands)
    add_compare(commands)
    return parser


_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name


# --- evaluate ------------------------------------------------------------------------------------


def _add_evaluate(commands: _Commands) -> None:
    text = "compare a trajectory with a reference"
    parser = commands.add_parser("evaluate", help=text, description=text)
    parser.set_defaults(handler=_evaluate)
    parser.add_argument("run_or_trajectory", type=Path, help="run folder or trajectory")
    text = "trajectory (TUM, EuRoC or KITTI), or sequence with one"
    parser.add_argument("--reference", type=Path, required=True, help=text)
    text = "stamps of a KITTI trajectory, one a line (default: those of the run's frames)"
    parser.add_argument("--times", type=Path, metavar="F", help=text)
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    parser.add_argument("--plot", type=Path, metavar="F", help="write the picture (png, pdf, svg)")
    parser.add_argument("--with-scale", action="store_true", help="align with Sim(3): monocular")
    text = "the reference is of another body on the camera, as markers or an IMU: find its place"
    parser.add_argument("--hand-eye", action="store_true", help=text)


def _evaluate(arguments: argparse.Namespace) -> int:
    from bmask_slam.evaluation import evaluate, format_json, format_table
    from bmask_slam.runtime.progress import console_log

    with console_log():
        result = evaluate(
            arguments.run_or_trajectory,
            arguments.reference,
            arguments.plot,
            arguments.with_scale,
            arguments.times,
            arguments.hand_eye,
        )
    print(format_json(result.rows) if arguments.json else format_table(result.rows))
    return 0


# --- render --------------------------------------------------------------------------------------


def _add_render(commands: _Commands) -> None:
    text = "render an indoor sequence with exact ground truth, in TUM layout"
    parser = commands.add_parser("render", help=text, description=text)
    parser.set_defaults(handler=_render)
    scenes = "office, busy_office, crowded_office, living_room, corridor or room"
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
    parser.add_argument("--sweeping", action="store_true", help="tilt and roll, as to calibrate")
    parser.add_argument("--true-depth", action="store_true", help="also write noise-free depth")
    parser.add_argument("--normals", action="store_true", help="also write surface normals")
    parser.add_argument("--quiet", action="store_true", help="print only the folder's path")


def _render(arguments: argparse.Namespace) -> int:
    from bmask_slam.rendering.sequence import RenderConfig, render_sequence
    from bmask_slam.runtime.progress import console_log, counting_bar

    names = (f.name for f in fields(RenderConfig) if f.name != "noise")
    given = {name: getattr(arguments, name) for name in names}
    config = RenderConfig(noise=not arguments.no_noise, **given)
    with console_log(), counting_bar(arguments.quiet) as progress:
        folder = render_sequence(config, arguments.out, progress)
    print(folder if arguments.quiet else f"Sequence {folder}; next: bmask-slam run {folder}")
    return 0


# --- info ----------------------------------------------------------------------------------------


def _add_info(commands: _Commands) -> None:
    text = "say what a sequence holds: frames, camera, depth, ground truth; of a bag its topics"
    parser = commands.add_parser("info", help=text, description=text)
    parser.set_defaults(handler=_info)
    parser.add_argument("sequence", type=Path, help="folder in TUM layout, or ROS bag")


def _info(arguments: argparse.Namespace) -> int:
    from bmask_slam.live.sources.bags import format_topics, is_bag, open_bag
    from bmask_slam.runtime.progress import console_log
    from bmask_slam.sequences import format_info, open_sequence, sequence_info

    if is_bag(arguments.sequence):
        with open_bag(arguments.sequence) as bag:
            print(format_topics(bag))
        return 0
    with console_log():
        info = sequence_info(open_sequence(arguments.sequence))
    print(format_info(info))
    return 0
