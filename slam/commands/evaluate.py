"""``bmask-slam evaluate``: the errors of a trajectory against a reference."""

from __future__ import annotations

import argparse
from pathlib import Path

from bmask_slam.commands.arguments import Commands


def add_evaluate(commands: Commands) -> None:
    """Add the command to the parser."""
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
