"""``bmask-slam calibrate``: the camera of a run from its observations."""

from __future__ import annotations

import argparse
from pathlib import Path

from bmask_slam.commands.arguments import Commands, add_output_arguments, print_result

TEXT = "calibrate the camera of a run from its own observations, and write camera.yaml"
MORE = """\
Focal lengths, principal point, distortion, depth offset and the time between colour and depth are
estimated together with all poses and landmarks, each with its 95 % bounds; what the motion did not
show is named. The depth scale needs something metric from outside: --reference, the camera's
positions by motion capture or odometry, or --known-distance. What a run with a wrong camera has
matched leans toward that camera: --rounds 2 runs the sequence again with the camera found and
calibrates that run. Use the result with "bmask-slam run SEQUENCE --camera RUN/camera.yaml"."""


def add_calibrate(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("calibrate", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_calibrate)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    parser.add_argument(
        "--out", type=Path, metavar="F", help="camera.yaml to write (default: RUN/camera.yaml)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace that file")
    parser.add_argument(
        "--sequence", type=Path, metavar="DIR", help="the run's images (default: where they were)"
    )
    _add_metric_arguments(parser)
    parser.add_argument(
        "--fix",
        action="append",
        default=[],
        metavar="NAME",
        help="keep a parameter, such as k1 or depth-offset",
    )
    parser.add_argument("--k3", action="store_true", help="estimate k3 too")
    parser.add_argument(
        "--rounds",
        type=int,
        default=1,
        metavar="N",
        help="calibrate up to N times, until all changes are within 95 %% bounds (default: 1)",
    )
    add_output_arguments(parser, "the file's path")


def _add_metric_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what gives the scale: a reference, or a known distance."""
    text = "TUM trajectory in metres, or sequence with one"
    parser.add_argument("--reference", type=Path, metavar="GT", help=text)
    parser.add_argument(
        "--hand-eye",
        action="store_true",
        help="the reference is of another body on the camera, as markers or an IMU: find its place",
    )
    parser.add_argument(
        "--known-distance",
        type=float,
        nargs=3,
        metavar=("T1", "T2", "METRES"),
        help="how far apart the camera was at two stamps",
    )
    parser.add_argument(
        "--anchor-sigma", type=float, default=0.01, metavar="M", help="of these (default: 0.01)"
    )


def _calibrate(arguments: argparse.Namespace) -> int:
    from bmask_slam.calibration.calibrate import CalibrateOptions
    from bmask_slam.calibration.config import CalibrationPriors
    from bmask_slam.calibration.report import format_calibration, plain_calibration
    from bmask_slam.offline.calibration_rounds import calibrate_in_rounds

    known = arguments.known_distance
    options = CalibrateOptions(
        run=arguments.run,
        out=arguments.out,
        sequence=arguments.sequence,
        reference=arguments.reference,
        on_body=arguments.hand_eye,
        known_distance=tuple(known) if known else None,
        anchor_sigma_m=arguments.anchor_sigma,
        fixed=tuple(arguments.fix),
        priors=CalibrationPriors(k3=0.2 if arguments.k3 else 0.0),
        overwrite=arguments.overwrite,
    )
    done = calibrate_in_rounds(options, arguments.rounds, arguments.quiet)
    told = plain_calibration(done)
    print_result(
        arguments, done.path, lambda: f"{format_calibration(done)}\n\nCamera  {done.path}", told
    )
    return 0
