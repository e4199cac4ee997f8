"""``bmask-slam live``: the live loop on a source of frames."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

from slam.commands.run import CONFIG_HELP, SET_HELP
from slam.commands.segmenter_arguments import add_segmenter_arguments, segmenter_options

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "track a source of frames as they come"
MORE = """\
Tracking is here; the map, its graph and loops, and segmentation have processes of their own. The
run folder is that of `run`, with health.json, which is rewritten every second."""


def add_live(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("live", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_live)
    parser.add_argument("source", type=Path, metavar="SOURCE", help="folder in TUM layout")
    parser.add_argument("--out", type=Path, help="run folder (default: runs/<source>, numbered)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that --out holds")
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="play a recording at its own speed, dropping frames that there is no time for",
    )
    parser.add_argument("--config", metavar="F", help=CONFIG_HELP)
    parser.add_argument("--set", metavar="A.B=C", action="append", default=[], help=SET_HELP)
    parser.add_argument("--camera", type=Path, metavar="F", help="camera.yaml in place of its own")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")
    add_segmenter_arguments(parser, "none")
    parser.add_argument("--quiet", action="store_true", help="print only the run folder's path")


def _live(arguments: argparse.Namespace) -> int:
    from slam.configuration import find_config, resolve
    from slam.evaluation import format_table
    from slam.live.live_slam import LiveOptions, LiveSlam
    from slam.live.play import PlayOptions, play
    from slam.live.sources import RecordedSource
    from slam.progress import console_log
    from slam.run_folder import free_run_path
    from slam.sequences import open_sequence
    from slam.system_config import SystemConfig

    file = find_config(arguments.config) if arguments.config else None
    plain = resolve(SystemConfig, file, arguments.set)
    segmenter = segmenter_options(arguments, plain.semantics.segmenter)
    config = replace(plain, semantics=replace(plain.semantics, segmenter=segmenter))
    with console_log():
        sequence = open_sequence(arguments.source, camera=arguments.camera)
        source = RecordedSource(sequence, arguments.realtime, arguments.max_frames)
        out = arguments.out or free_run_path(f"{source.name}-live")
        options = LiveOptions(
            out, arguments.overwrite, source.groundtruth, sequence.folder, source.name
        )
        with LiveSlam(source.camera, config, options) as slam:
            ended_by = play(slam, source, PlayOptions(arguments.realtime, quiet=arguments.quiet))
    if arguments.quiet:
        print(out)
    else:
        print(f"{format_table(slam.rows)}\n\nRun folder  {out}")
    return 128 + ended_by if ended_by else 0
