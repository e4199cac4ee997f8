"""``bmask-slam query``: where the objects of a label are in a finished run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "say where a run has found the objects of a label"
MORE = """\
For each object: position and size in metres in the run's world frame (the first keyframe's
camera; sizes are length, width, height), how sure its label is, and the keyframes that saw it.
Without a label all objects are listed. objects.json in the run folder holds the same and more."""


def add_query(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("query", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_query)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run with a segmenter")
    parser.add_argument("label", nargs="?", help='class name, such as "chair"; default: all')


def _query(arguments: argparse.Namespace) -> int:
    from bmask_slam.run_folder.query import format_answer, query

    print(format_answer(query(arguments.run, arguments.label)))
    return 0
