"""``bmask-slam view``: a finished run in Rerun."""

from __future__ import annotations

import argparse
from pathlib import Path

from bmask_slam.commands.arguments import Commands, add_view_arguments, view_options

TEXT = "show a finished run in Rerun"
MORE = """\
The map with labels and objects, the camera's path, loops, the dense cloud where there is one, and
status and times of every frame. Needs  pip install 'bmask-slam[view]'."""


def add_view(commands: Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("view", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_view)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a finished run")
    add_view_arguments(parser)


def _view(arguments: argparse.Namespace) -> int:
    from bmask_slam.viewer.replay import replay
    from bmask_slam.viewer.scene import Scene

    scene = Scene(arguments.run.name, view_options(arguments, window=True))
    count = replay(arguments.run, scene)
    print(f"{count} frames of {arguments.run}")
    try:
        if arguments.serve:
            print(f"in a browser: {scene.url}  (Ctrl-C ends it)", flush=True)
            _wait()
    finally:
        scene.close()
    return 0


def _wait() -> None:
    import threading

    threading.Event().wait()
