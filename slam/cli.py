"""The command line. Each handler builds a configuration, calls one library function and prints.

Heavy modules are imported inside the handlers, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any

from bmask_slam import __version__
from bmask_slam.commands.calibrate import add_calibrate
from bmask_slam.commands.compare import add_compare
from bmask_slam.commands.evaluate import add_evaluate
from bmask_slam.commands.live import add_live
from bmask_slam.commands.map import add_map, add_merge
from bmask_slam.commands.optimise import add_optimise
from bmask_slam.commands.results import add_export, add_query
from bmask_slam.commands.run import add_run
from bmask_slam.commands.segmentation import add_evaluate_segmentation, add_segment, add_train
from bmask_slam.commands.sequences import add_convert, add_download, add_info, add_render
from bmask_slam.commands.view import add_view
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.extras import import_extra
from bmask_slam.runtime.memory import is_out_of_memory, memory_limit_bytes
from bmask_slam.runtime.stop_request import SIGNALS

DESCRIPTION = "RGB-D SLAM on a GTSAM factor graph: a trajectory and a landmark map from a sequence."
EPILOG = """\
first steps:
  bmask-slam render office --frames 200 --out office   make a small sequence with exact truth
  bmask-slam run office                                run on it; results go to runs/office
  bmask-slam evaluate runs/office --reference office   compare a trajectory with a reference

exit status: 0 done, 1 broken input or a part that failed (one line says what), 2 a wrong command
line, 128 + N ended by signal N (130: Ctrl-C); what was done until then is saved
"""
SPACE, RIGHTS, DESCRIPTORS, DEVICE = (
    "free some space",
    "change its permissions, or choose another place",
    "raise the limit of open files: ulimit -n 4096",
    "the disk or the connection to it fails; try again on another",
)
CURES = {
    **{errno.ENOSPC: SPACE, errno.EDQUOT: SPACE, errno.EFBIG: SPACE},
    **{errno.EACCES: RIGHTS, errno.EPERM: RIGHTS, errno.EROFS: RIGHTS},
    **{errno.EMFILE: DESCRIPTORS, errno.ENFILE: DESCRIPTORS},
    **{errno.EIO: DEVICE, errno.ESTALE: DEVICE, errno.ENODEV: DEVICE},
    **{errno.ENAMETOOLONG: "choose a shorter name", errno.ELOOP: "remove the link"},
}
MEMORY = "out of memory; free some, raise its limit (ulimit -v), or take smaller input"
MIN_MEMORY_BYTES = 3_000_000_000
"""Of addresses. With less OpenBLAS does not load, crashes, or tries without an end to get some."""
MAX_LINE = 480
"""Characters of an error: what a file holds may be of any length."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, 1 for broken input, 2 for a wrong command line, and
    128 + signal when a signal ended it.
    """
    try:
        arguments = make_parser().parse_args(argv)
        _check_memory()
        with _terminations():
            code = int(arguments.handler(arguments))
        if code == 128 + signal.SIGHUP:  # the terminal was closed: nobody reads on
            _discard_output()
        return code
    except InputError as error:
        return _fail(str(error))
    except BrokenPipeError:  # `bmask-slam info ... | head`: nobody reads on
        _discard_output()
        return 128 + signal.SIGPIPE
    except (OSError, MemoryError, ImportError, RuntimeError) as error:
        return _after_refusal(error)
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    except _Terminated as ended:
        with suppress(OSError):
            print(f"ended by {ended.number.name}", file=sys.stderr)
        return 128 + ended.number


def _discard_output() -> None:
    """Let the rest of what was printed go nowhere: the end of Python would fail to write it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(nowhere, stream.fileno())


def _check_memory() -> None:
    """Raise InputError if a limit leaves too little memory for the libraries."""
    limit = memory_limit_bytes()
    if limit is not None and limit < MIN_MEMORY_BYTES:
        cure = f"this program needs {MIN_MEMORY_BYTES / 1e9:g} GB: ulimit -v unlimited"
        raise InputError(f"memory is limited to {limit / 1e9:.2g} GB (ulimit -v); {cure}")


def _after_refusal(error: Exception) -> int:
    """The exit status after what the machine refuses; another error is raised again."""
    if is_out_of_memory(error):
        return _fail(MEMORY)
    if not isinstance(error, OSError):
        raise error
    if error.errno == errno.EIO and error.filename is None:  # the terminal was closed
        _discard_output()
        return 128 + signal.SIGHUP
    if error.errno not in CURES:
        raise error
    return _fail(f"{error.filename or 'output'}: {error.strerror}; {CURES[error.errno]}")


class _Terminated(BaseException):
    """A signal that ends a process came where nothing waits for it, as during start-up."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number


@contextmanager
def _terminations() -> Iterator[None]:
    """SIGTERM and SIGHUP raise _Terminated, unless the caller of the program ignores them."""
    previous: dict[signal.Signals, Any] = {}

    def end(number: int, frame: FrameType | None) -> None:
        raise _Terminated(signal.Signals(number))

    if threading.current_thread() is threading.main_thread():
        for number in SIGNALS:
            if signal.getsignal(number) is signal.SIG_DFL:
                previous[number] = signal.signal(number, end)
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def _fail(message: str) -> int:
    line = " ".join(message.split())
    if len(line) > MAX_LINE:
        line = f"{line[: MAX_LINE - 3]}..."
    print(f"error: {line}", file=sys.stderr)
    return 1


class _PrintCompletion(argparse.Action):
    """Prints the tab completion of a shell, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *given: Any) -> None:
        _, shell, _ = given
        shtab: Any = import_extra("shtab", "--print-completion", "completion")
        print(shtab.complete(parser, shell))
        parser.exit()


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands; each stores its function as ``handler``."""
    parser = argparse.ArgumentParser(
        prog="bmask-slam",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"bmask-slam {__version__}")
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        choices=("bash", "zsh", "tcsh"),
        help="tab completion for a shell; see docs/install.md",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    add_run(commands)
    add_live(commands)
    add_evaluate(commands)
    add_render(commands)
    add_convert(commands)
    add_info(commands)
    add_download(commands)
    add_optimise(commands)
    add_export(commands)
    add_calibrate(commands)
    add_map(commands)
    add_merge(commands)
    add_query(commands)
    add_view(commands)
    add_segment(commands)
    add_train(commands)
    add_evaluate_segmentation(commands)
    add_compare(commands)
    return parser
