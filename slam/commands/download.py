"""``bmask-slam download``: published recordings from where they were published."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TypeAlias

_Commands: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # no public name

TEXT = "fetch published recordings (TUM, Bonn, ICL-NUIM) from where they were published"
MORE = """\
A download that was interrupted goes on where it stopped. Size and SHA-256 are checked where they
are known; where they are not, those of the first download are kept in DIR/SHA256SUMS, and later
ones must agree. compare finds the recordings in DIR by --data DIR."""


def add_download(commands: _Commands) -> None:
    """Add the command to the parser."""
    parser = commands.add_parser("download", help=TEXT, description=f"{TEXT}. {MORE}")
    parser.set_defaults(handler=_download)
    parser.add_argument("names", nargs="*", metavar="SEQUENCE", help="such as tum/freiburg1_xyz")
    parser.add_argument("--to", type=Path, default=Path("data"), metavar="DIR",
                        help="where sequences go, each to DIR/SET/NAME (data)")  # fmt: skip
    parser.add_argument("--list", action="store_true", help="name all sequences, with sizes")
    parser.add_argument("--keep-archive", action="store_true", help="do not remove the archive")
    parser.add_argument("--catalogue", type=Path, metavar="F", help="another list of sequences")
    parser.add_argument("--quiet", action="store_true", help="print only the folders' paths")


def _download(arguments: argparse.Namespace) -> int:
    from bmask_slam.datasets.catalogue import find, format_catalogue, read_catalogue
    from bmask_slam.datasets.obtain import obtain
    from bmask_slam.graph.errors import InputError
    from bmask_slam.runtime.progress import byte_bars, console_log

    catalogue = read_catalogue(arguments.catalogue)
    if arguments.list:
        print(format_catalogue(catalogue))
        return 0
    if not arguments.names:
        raise InputError("download: no sequence is named; --list names all")
    for recording in [find(catalogue, name) for name in arguments.names]:
        with console_log(), byte_bars(arguments.quiet) as progress:
            folder = obtain(recording, arguments.to, progress, arguments.keep_archive)
        about = f"  ({recording.title}; {recording.licence}; {recording.page})"
        print(folder if arguments.quiet else f"Sequence {folder}{about}")
    return 0
