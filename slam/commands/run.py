"""``bmask-slam run``: a sequence through the system, from the start or from a checkpoint."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from bmask_slam.commands.segmenter_arguments import add_segmenter_arguments, segmenter_options
from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.offline.runner import RunSummary

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

CONFIG_HELP = "YAML file, or the name of a shipped one such as 'paper'"
SET_HELP = "one value of the configuration, such as tracking.min_inliers=20; may be repeated"
EPILOG = """\
long runs and known places:
  bmask-slam run hall --out h --checkpoint-every 300   one that may be killed
  bmask-slam run --resume h                            goes on from its last checkpoint
  bmask-slam run hall2 --continue h                    another recording of the place: one map
  bmask-slam run hall3 --localise h                    only where the camera was in that map
"""
OPTIONS = (
    "out",
    "camera",
    "reference",
    "max_frames",
    "stride",
    "checkpoint_every",
    "map",
    "localise",
    "dense",
)


def add_run(commands: _Commands) -> None:
    """Add the command to the parser."""
    text = "run the system over a sequence and write a run folder"
    parser = commands.add_parser(
        "run",
        help=text,
        description=text,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(handler=_run)
    parser.add_argument("sequence", type=Path, nargs="?", help="folder in TUM layout")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<sequence>, numbered)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that --out holds")
    parser.add_argument("--config", metavar="F", help=CONFIG_HELP)
    parser.add_argument("--set", metavar="A.B=C", action="append", default=[], help=SET_HELP)
    parser.add_argument("--print-config", action="store_true", help="print it resolved, and end")
    parser.add_argument("--camera", type=Path, metavar="F", help="camera.yaml in place of its own")
    parser.add_argument("--reference", type=Path, metavar="F", help="trajectory to compare to")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")
    parser.add_argument("--stride", type=int, metavar="N", help="take every N-th frame")
    parser.add_argument(
        "--checkpoint-every",
        type=int,
        metavar="N",
        help="write a checkpoint every N frames; 300 is a good number",
    )
    parser.add_argument("--resume", type=Path, metavar="RUN", help="go on with a killed run")
    parser.add_argument(
        "--continue", dest="map", type=Path, metavar="MAP", help="run or map file to go on with"
    )
    parser.add_argument(
        "--localise", type=Path, metavar="MAP", help="only find the frames in a map, unchanged"
    )
    text = "also a dense map, as by bmask-slam map"
    parser.add_argument("--map", dest="dense", action="store_true", default=None, help=text)
    parser.add_argument(
        "--covariances",
        dest="set",
        action="append_const",
        const="covariances=true",
        help="also write covariances.txt: how sure the graph is of each keyframe",
    )
    add_segmenter_arguments(parser, "light")
    parser.add_argument("--quiet", action="store_true", help="print only the run folder's path")


def _run(arguments: argparse.Namespace) -> int:
    from bmask_slam.config.configuration import dump, find_config, resolve
    from bmask_slam.offline.runner import RunOptions, resume, run
    from bmask_slam.runtime.progress import console_log
    from bmask_slam.system_config import SystemConfig

    file = find_config(arguments.config) if arguments.config else None
    plain = resolve(SystemConfig, file, arguments.set)
    segmenter = segmenter_options(arguments, plain.semantics.segmenter)
    config = replace(plain, semantics=replace(plain.semantics, segmenter=segmenter))
    if arguments.print_config:
        print(dump(config), end="")
        return 0
    given: dict[str, Any] = {"quiet": arguments.quiet}
    given |= {name: v for name in OPTIONS if (v := getattr(arguments, name)) is not None}
    if arguments.sequence:
        given["sequence"] = arguments.sequence
    if arguments.resume:
        if file or arguments.set or config != plain:
            given["config"] = config
        if arguments.overwrite:
            raise InputError("--overwrite: would delete what --resume needs; give one of the two")
        with console_log():
            summary = resume(arguments.resume, given)
    elif arguments.sequence:
        given |= {"config": config, "config_name": file.stem if file else ""}
        with console_log():
            summary = run(RunOptions(**given, overwrite=arguments.overwrite))
    else:
        raise InputError("run: no sequence; give a folder in TUM layout, or --resume RUN")
    if summary is None:
        print(arguments.resume if arguments.quiet else f"{arguments.resume} is finished already")
        return 0
    _print_summary(summary, arguments.quiet)
    return 128 + summary.stopped_by if summary.stopped_by else 0


def _print_summary(summary: RunSummary, quiet: bool) -> None:
    from bmask_slam.evaluation import format_table

    if quiet:
        print(summary.folder)
        return
    print(format_table(summary.rows))
    if summary.skipped:
        print(f"\n{summary.skipped} broken frames were skipped, see log.txt")
    if summary.stopped_by:
        print(f"\nStopped by {summary.stopped_by.name} after {summary.frames} frames; all is saved")
    if summary.resumable:
        print(f"Go on with  bmask-slam run --resume {summary.folder}")
    print(f"\nRun folder  {summary.folder}\nPicture     {summary.folder / 'trajectory.png'}")
