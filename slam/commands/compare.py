"""``bmask-slam compare``: sequences x configurations x seeds, with other systems beside them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from bmask_slam.commands.arguments import Commands, add_output_arguments, print_result
from bmask_slam.graph.errors import InputError

if TYPE_CHECKING:
    from bmask_slam.comparison.experiment.options import CompareOptions

TEXT = "compare configurations and other systems on sequences, with a report"
MORE = """\
Every cell of sequences x configurations x seeds is run in a process of its own and kept in --out:
called again, it goes on where it stopped, and only what has changed is run anew. The
exit status is 1 if a cell failed."""
EPILOG = """\
examples:
  bmask-slam compare rendered --out runs/rendered      needs nothing but this program
  bmask-slam compare tum-static --data ~/tum           recordings in ~/tum/rgbd_dataset_...
  bmask-slam compare paper --trajectory "RGB-D SLAM (run):freiburg1_xyz=estimate.txt"
"""


def add_compare(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser(
        "compare",
        help=TEXT,
        description=f"{TEXT}. {MORE}",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(handler=_compare)
    parser.add_argument("experiment", help="YAML file, or the name of a shipped one: rendered")
    parser.add_argument("--out", type=Path, metavar="DIR", help="default: runs/compare-<name>")
    parser.add_argument(
        "--data", type=Path, action="append", default=[], metavar="DIR",
        help="folder with recordings and trajectories; may be repeated (also: BMASK_SLAM_DATA)",
    )  # fmt: skip
    parser.add_argument(
        "--reference", action="append", default=[], metavar="SEQUENCE=FILE", help="ground truth"
    )
    parser.add_argument(
        "--trajectory", action="append", default=[], metavar="METHOD:SEQUENCE=FILE",
        help="another system's trajectory, in TUM format; SEQUENCE@SEED of a rendered one; "
        "METHOD:*=PATTERN, as results/{sequence}*.txt, for all",
    )  # fmt: skip
    parser.add_argument("--sequences", metavar="A,B", help="only these")
    parser.add_argument("--configurations", metavar="A,B", help="only these")
    parser.add_argument("--seeds", metavar="0,1", help="in place of the experiment's")
    parser.add_argument("--jobs", type=int, metavar="N", help="at a time (default: one a core)")
    parser.add_argument("--ray", metavar="ADDRESS", help="run on a Ray cluster: address, or auto")
    parser.add_argument("--with-scale", action="store_true", help="align by Sim(3): monocular")
    add_output_arguments(parser, "the folder's path")


def _compare(arguments: argparse.Namespace) -> int:
    from bmask_slam.comparison.comparing import compare
    from bmask_slam.comparison.experiment.experiment_file import find_experiment
    from bmask_slam.comparison.experiment.result import CellStatus
    from bmask_slam.comparison.statistics import verdicts
    from bmask_slam.comparison.text import format_comparison

    name = find_experiment(arguments.experiment).stem
    out = arguments.out or Path("runs") / f"compare-{name}"
    comparison = compare(arguments.experiment, out, _options(arguments))
    page = out / "report.html"
    told = {"folder": out, "report": page, "verdicts": verdicts(comparison)}
    told |= {"sequences": comparison.sequences, "cells": comparison.cells}
    print_result(arguments, out, lambda: f"{format_comparison(comparison)}\n\nReport  {page}", told)
    return int(any(cell.status is CellStatus.FAILED for cell in comparison.cells))


def _options(arguments: argparse.Namespace) -> CompareOptions:
    from bmask_slam.comparison.experiment.options import CompareOptions, parse_trajectory

    return CompareOptions(
        data=tuple(arguments.data),
        references=dict(_reference(text) for text in arguments.reference),
        trajectories=dict(parse_trajectory(text) for text in arguments.trajectory),
        seeds=_seeds(arguments.seeds),
        sequences=_names(arguments.sequences),
        configurations=_names(arguments.configurations),
        workers=arguments.jobs,
        ray=arguments.ray,
        with_scale=arguments.with_scale,
        quiet=arguments.quiet,
    )


def _reference(text: str) -> tuple[str, Path]:
    sequence, separator, file = text.partition("=")
    if not (separator and sequence and file):
        raise InputError(f"--reference {text}: write it as SEQUENCE=FILE")
    return sequence, Path(file)


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(","))


def _seeds(text: str | None) -> tuple[int, ...] | None:
    names = _names(text)
    if names is None:
        return None
    if not all(name.isdecimal() for name in names):
        raise InputError(f"--seeds {text}: write whole numbers, as 0,1,2")
    return tuple(dict.fromkeys(map(int, names)))
