"""``bmask-slam query`` and ``export``: contents of a finished run."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

from bmask_slam.commands.arguments import Commands, add_output_arguments, print_result

MOST = 10
DRIVE = ("nav2", "octomap")
QUERY = "say where a run has found the objects of a label"
QUERY_MORE = """\
For each object: position and size in metres in the run's world frame (the first keyframe's
camera; sizes are length, width, height), how sure its label is, and the keyframes that saw it.
Without a label the surest are listed, with --near the nearest. Relations are those of boxes: on,
under, inside, or beside with less than half a metre between. objects.json holds the same."""
EXPORT = "write a trajectory, a graph or landmarks in a format that other programs read"
EXPORT_MORE = """\
From a run folder: its trajectory as tum, kitti or euroc, its graph with landmarks and what was seen
of them as g2o, its landmarks as ply, those on objects in the objects' colours as objects-ply, and
room, surfaces, objects and their relations as scene-graph (JSON). From a trajectory: tum, kitti,
euroc, or its positions as ply. From a g2o file with landmarks: ply. KITTI's format has no stamps:
they go to a second file. With a dense map: a map to drive on for nav2 (.yaml
and .pgm) or octomap (.bt)."""


def add_query(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("query", help=QUERY, description=f"{QUERY}. {QUERY_MORE}")
    parser.set_defaults(handler=_query)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run with a segmenter")
    text = f'class name, such as "chair"; default: the {MOST} surest objects of all classes'
    parser.add_argument("label", nargs="?", help=text)
    parser.add_argument("--all", action="store_true", help="without a label: all objects")
    text = "the nearest to a place first: its coordinates in the world frame, in metres"
    parser.add_argument("--near", nargs=3, type=float, metavar=("X", "Y", "Z"), help=text)
    parser.add_argument("--json", action="store_true", help="print the answer as JSON")
    related = parser.add_mutually_exclusive_group()
    for kind in ("on", "under", "inside", "beside"):
        text = f"only what is {kind} an object of this label or id; without it, {kind} any"
        related.add_argument(f"--{kind}", nargs="?", const="", metavar="OTHER", help=text)


def _query(arguments: argparse.Namespace) -> int:
    import numpy as np

    from bmask_slam.run_folder.scene.query import (
        RELATIONS,
        Asked,
        answer_as_json,
        ask,
        format_answer,
    )

    given = {kind: getattr(arguments, kind) for kind in RELATIONS}
    relation = next((kind for kind, other in given.items() if other is not None), None)
    limited = arguments.label is None and not arguments.all and relation is None
    asked = Asked(
        arguments.label,
        None if arguments.near is None else np.array(arguments.near),
        relation,
        given[relation] if relation is not None else "",
        MOST if limited else None,
    )
    answer = ask(arguments.run, asked)
    print(answer_as_json(answer) if arguments.json else format_answer(answer))
    return 0


def add_export(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("export", help=EXPORT, description=f"{EXPORT}. {EXPORT_MORE}")
    parser.set_defaults(handler=_export)
    parser.add_argument("input", type=Path, metavar="INPUT", help="run folder, trajectory, or g2o")
    formats = ("tum", "kitti", "euroc", "g2o", "ply", "scene-graph", "objects-ply", *DRIVE)
    parser.add_argument("--format", choices=formats, required=True, help="what to write")
    parser.add_argument("--out", type=Path, required=True, metavar="F", help="file to write")
    parser.add_argument(
        "--times", type=Path, metavar="F", help="stamps of a KITTI trajectory, one a line"
    )
    text = "of nav2 and octomap: edge of a cell in metres (default: 0.05)"
    parser.add_argument("--resolution", type=float, default=0.05, metavar="M", help=text)
    text = "of nav2: obstacles stand from LOW to HIGH metres above the floor (default: 0.1 1.5)"
    parser.add_argument(
        "--heights", nargs=2, type=float, default=(0.1, 1.5), metavar=("LOW", "HIGH"), help=text
    )
    add_output_arguments(parser, "the paths")


def _export_drive_map(arguments: argparse.Namespace) -> int:
    from bmask_slam.dense.drive_map import DriveMapOptions, export_drive_map

    options = DriveMapOptions(arguments.resolution, *arguments.heights)
    files, text = export_drive_map(arguments.input, arguments.format, arguments.out, options)
    return _print_exported(arguments, files, text)


def _export(arguments: argparse.Namespace) -> int:
    if arguments.format in DRIVE:
        return _export_drive_map(arguments)
    from bmask_slam.run_folder.export import export

    exported = export(arguments.input, arguments.format, arguments.out, arguments.times)
    return _print_exported(arguments, exported.files, exported.contents)


def _print_exported(arguments: argparse.Namespace, files: Iterable[Path], contents: str) -> int:
    paths = "\n".join(map(str, files))
    told = {"files": list(files), "contents": contents}
    print_result(arguments, paths, lambda: f"{paths}\n\n{contents}", told)
    return 0
