"""``bmask-slam export``: trajectory, graph or landmarks in a format that other programs read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "write a trajectory, a graph or landmarks in a format that other programs read"
MORE = """\
From a run folder: its trajectory as tum, kitti or euroc, its graph with landmarks and what was seen
of them as g2o, its landmarks as ply. From a trajectory: tum, kitti, euroc, or its positions as ply.
From a g2o file with landmarks: ply. KITTI's format has no stamps: they go to a second file."""


def add_export(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("export", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_export)
    parser.add_argument("input", type=Path, metavar="INPUT", help="run folder, trajectory, or g2o")
    formats = ("tum", "kitti", "euroc", "g2o", "ply")
    parser.add_argument("--format", choices=formats, required=True, help="what to write")
    parser.add_argument("--out", type=Path, required=True, metavar="F", help="file to write")
    parser.add_argument(
        "--times", type=Path, metavar="F", help="stamps of a KITTI trajectory, one a line"
    )
    parser.add_argument("--quiet", action="store_true", help="print only the paths")


def _export(arguments: argparse.Namespace) -> int:
    from bmask_slam.run_folder.export import export
    from bmask_slam.runtime.progress import console_log

    with console_log():
        exported = export(arguments.input, arguments.format, arguments.out, arguments.times)
    print("\n".join(str(path) for path in exported.files))
    if not arguments.quiet:
        print(f"\n{exported.contents}")
    return 0
