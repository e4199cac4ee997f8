"""``view``, ``report``, ``film``, ``doctor``: a run in a viewer, as page or film; the machine."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path

from bmask_slam.commands.arguments import (
    Commands,
    add_output_arguments,
    add_view_arguments,
    print_result,
    view_options,
)

VIEW = "show a finished run in Rerun or Foxglove"
VIEW_MORE = """\
The map with labels and objects, the camera's path, loops, the dense cloud where there is one, and
status, times and uncertainty of every frame; its images, and masks of keyframes made anew, where
the recording is still there. Needs  pip install 'bmask-slam[view]', or [foxglove]."""
REPORT = "write a web page about a run: figures, warnings, plots, pictures"
REPORT_MORE = """\
One file that needs no network: open it in any browser, send it by mail. Also for a run that goes on
or was stopped; what is not there is left out."""
FILM = "write a short film of a run: its images beside the map that grows"
FILM_MORE = """\
With the camera's path and the objects by name. The map is the dense one if there is one, else it is
made of the film's depth images. A .gif or .webp begins again at its end. Give it after the run:
the next report shows it."""
DOCTOR = "say what is installed, which cameras are there, and how fast this machine is"
DOCTOR_MORE = """\
Loads every library that is installed, asks every camera library for its cameras, looks at memory,
disk and limits, and measures tracking, iSAM2 and the network for a few seconds; says what each
extra that is not there is for, what it costs, and the command. Exit status: 0 if nothing is wrong
(an extra or a camera that is not there is no fault), 1 if the core lacks a library, an installed
one cannot be loaded, or memory, disk or open files are too few for a run."""


def add_view(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("view", help=VIEW, description=f"{VIEW}. {VIEW_MORE}")
    parser.set_defaults(handler=_view)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="its images, if they moved")
    parser.add_argument("--no-images", action="store_true", help="show the map and plots alone")
    add_view_arguments(parser)


def _view(arguments: argparse.Namespace) -> int:
    from bmask_slam.viewer.replay import ReplayOptions, read_shown, replay
    from bmask_slam.viewer.scene import Scene

    where = view_options(arguments, window=True)
    # Before a window opens, or a recording of before is replaced.
    read_shown(arguments.run, arguments.sequence)
    scene = Scene(arguments.run.name, where)
    options = ReplayOptions(
        arguments.sequence, not arguments.no_images, paced=where.foxglove_port > 0
    )
    try:
        for address in scene.addresses:
            print(f"{address}  (Ctrl-C ends it)", flush=True)
        count = replay(arguments.run, scene, options)
        print(f"{count} frames of {arguments.run}", flush=True)
        while where.foxglove_port:  # again and again, for who connects later
            replay(arguments.run, scene, options)
        if where.serve:
            _wait()
    finally:
        scene.close()
    return 0


def _wait() -> None:
    import threading

    threading.Event().wait()


def add_report(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("report", help=REPORT, description=f"{REPORT}. {REPORT_MORE}")
    parser.set_defaults(handler=_report)
    parser.add_argument("run", type=Path, metavar="RUN", help="run folder")
    text = "page to write (default: RUN/report.html)"
    parser.add_argument("--out", type=Path, metavar="F", help=text)
    text = "trajectory to compare to, or sequence with one (default: that of the run's sequence)"
    parser.add_argument("--reference", type=Path, metavar="GT", help=text)
    add_output_arguments(parser, "the page's path")


def _report(arguments: argparse.Namespace) -> int:
    from bmask_slam.reporting.run_report import write_run_report

    page = write_run_report(arguments.run, arguments.out, arguments.reference)
    print_result(arguments, page, lambda: f"Report      {page}", {"report": page})
    return 0


def add_film(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("film", help=FILM, description=f"{FILM}. {FILM_MORE}")
    parser.set_defaults(handler=_film)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    text = "film to write: .gif, .webp or .mp4 (default: RUN/film.gif)"
    parser.add_argument("--out", type=Path, metavar="F", help=text)
    parser.add_argument("--sequence", type=Path, metavar="DIR", help="its images, if they moved")
    parser.add_argument(
        "--seconds", type=float, default=6.0, metavar="S", help="its length (default: 6)"
    )
    parser.add_argument(
        "--fps", type=float, default=10.0, metavar="HZ", help="pictures a second (default: 10)"
    )
    parser.add_argument(
        "--width", type=int, default=720, metavar="PX", help="of the film (default: 720)"
    )
    add_output_arguments(parser, "the film's path")


def _film(arguments: argparse.Namespace) -> int:
    from bmask_slam.reporting.film import FilmOptions, write_film
    from bmask_slam.runtime.progress import counting_bar

    numbers = arguments.seconds, arguments.fps, arguments.width
    options = FilmOptions(arguments.run, arguments.out, arguments.sequence, *numbers)
    with counting_bar(arguments.quiet) as progress:
        film = write_film(options, progress)
    print_result(arguments, film, lambda: f"Film        {film}", {"film": film})
    return 0


def add_doctor(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("doctor", help=DOCTOR, description=f"{DOCTOR}. {DOCTOR_MORE}")
    parser.set_defaults(handler=_doctor)
    parser.add_argument("--quick", action="store_true", help="do not measure the speed")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def _doctor(arguments: argparse.Namespace) -> int:
    from bmask_slam.doctor.checkup import check, format_checkup

    found = check(with_speed=not arguments.quick)
    if arguments.json:
        from bmask_slam.graph.files.json_file import format_json  # needs numpy, which may be broken

        told = found.speed.expectations() if found.speed else []
        print(format_json(asdict(found) | {"expectations": told}))
    else:
        print(format_checkup(found))
    return 1 if found.problems else 0
