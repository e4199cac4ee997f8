"""``bmask-slam view``: a finished run in Rerun."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from bmask_slam.viewer.scene import ViewOptions

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "show a finished run in Rerun"
MORE = """\
The map with labels and objects, the camera's path, loops, the dense cloud where there is one, and
status and times of every frame. Needs  pip install 'bmask-slam[view]'."""
WEB_PORT = 9090


def add_view(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("view", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_view)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    add_view_arguments(parser)


def add_view_arguments(parser: argparse.ArgumentParser) -> None:
    """Add where it goes: --record or --serve."""
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--record", type=Path, metavar="F.rrd", help="write a Rerun recording")
    where.add_argument(
        "--serve",
        type=int,
        nargs="?",
        const=WEB_PORT,
        default=0,
        metavar="PORT",
        help=f"show it in a browser (port {WEB_PORT})",
    )


def view_options(arguments: argparse.Namespace, window: bool) -> ViewOptions:
    """What was asked for; ``window``: Rerun's own window, if nothing else was."""
    from bmask_slam.viewer.scene import ViewOptions

    elsewhere = arguments.record is not None or arguments.serve > 0
    return ViewOptions(arguments.record, arguments.serve, window and not elsewhere)


def _view(arguments: argparse.Namespace) -> int:
    from bmask_slam.viewer.replay import replay
    from bmask_slam.viewer.scene import Scene

    scene = Scene(arguments.run.name, view_options(arguments, window=True))
    count = replay(arguments.run, scene)
    print(f"{count} frames of {arguments.run}")
    if arguments.serve:
        print(f"in a browser: http://localhost:{arguments.serve}  (Ctrl-C ends it)")
        _wait()
    scene.close()
    return 0


def _wait() -> None:
    import threading

    threading.Event().wait()
