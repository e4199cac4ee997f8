"""The command line. Each handler builds a configuration, calls one library function and prints.

Heavy modules are imported inside the handlers, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import errno
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from bmask_slam import __version__
from bmask_slam.commands.calibrate import add_calibrate
from bmask_slam.commands.compare import add_compare
from bmask_slam.commands.evaluate import add_evaluate
from bmask_slam.commands.live import add_live, add_workstation
from bmask_slam.commands.map import add_map, add_merge
from bmask_slam.commands.optimise import add_optimise
from bmask_slam.commands.results import add_export, add_query
from bmask_slam.commands.run import add_run
from bmask_slam.commands.segmentation import add_evaluate_segmentation, add_segment, add_train
from bmask_slam.commands.sequences import add_convert, add_download, add_info, add_render
from bmask_slam.commands.show import add_doctor, add_film, add_report, add_view
from bmask_slam.graph.errors import InputError, did_you_mean, one_line
from bmask_slam.graph.extras import import_extra
from bmask_slam.graph.files.whole_file import DISK_FULL
from bmask_slam.runtime.memory import is_out_of_memory, keep_little_memory, memory_limit_bytes
from bmask_slam.runtime.standard_streams import (
    discard_output,
    is_terminal_closed,
    prepare_streams,
)
from bmask_slam.runtime.stop_request import SIGNALS

ADDED = (
    add_run,
    add_live,
    add_workstation,
    add_evaluate,
    add_render,
    add_convert,
    add_info,
    add_download,
    add_optimise,
    add_export,
    add_calibrate,
    add_map,
    add_merge,
    add_query,
    add_report,
    add_film,
    add_view,
    add_segment,
    add_train,
    add_evaluate_segmentation,
    add_compare,
    add_doctor,
)
"""What adds a command, in the order of --help."""
DESCRIPTION = "RGB-D SLAM on a GTSAM factor graph: a trajectory and a landmark map from a sequence."
EPILOG = """\
first steps:
  bmask-slam render office --frames 200 --out office   make a small sequence with exact truth
  bmask-slam run office                                run on it; results go to runs/office
  bmask-slam evaluate runs/office --reference office   compare a trajectory with a reference

exit status: 0 done, 1 broken input or a part that failed (one line says what), 2 a wrong command
line, 128 + N ended by signal N (130: Ctrl-C); what was done until then is saved
"""
SPACE, RIGHTS, DESCRIPTORS, DEVICE, PLACE = (
    "free some space",
    "change its permissions, or choose another place",
    "raise the limit of open files: ulimit -n 4096",
    "the disk or the connection to it fails; try again on another",
    "a file is where a folder has to be, choose another place",
)
CURES = {
    **dict.fromkeys(DISK_FULL, SPACE),
    **{errno.EACCES: RIGHTS, errno.EPERM: RIGHTS, errno.EROFS: RIGHTS},
    **{errno.EMFILE: DESCRIPTORS, errno.ENFILE: DESCRIPTORS},
    **{errno.EIO: DEVICE, errno.ESTALE: DEVICE, errno.ENODEV: DEVICE},
    **{errno.ENOTDIR: PLACE, errno.EEXIST: PLACE},
    **{errno.ENAMETOOLONG: "choose a shorter name", errno.ELOOP: "remove the link"},
}
MEMORY = "out of memory; free some, raise its limit (ulimit -v), or take smaller input"
MIN_MEMORY_BYTES = 3_000_000_000
"""Of addresses. With less OpenBLAS does not load, crashes, or tries without an end to get some."""
WAITING = {"OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
"""Set unless the user has set them, before the libraries are loaded. Matrices here are small: a
second thread of OpenBLAS gains nothing, and spins while it waits. Beside other work on the machine,
which then waits for a core, a run took two to three times as long."""
CHOICE = re.compile(r"invalid choice: '(.*?)' \(choose from (.*)\)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; the exit status is 0, 1 for broken input, 2 for a wrong command line, and
    128 + signal when a signal ended it.
    """
    for name, value in WAITING.items():
        os.environ.setdefault(name, value)
    keep_little_memory()
    prepare_streams()
    try:
        code = _run(argv)
        if code == 128 + signal.SIGHUP:  # the terminal was closed: nobody reads on
            discard_output()
        return code
    except InputError as error:
        return _fail(str(error))
    except BrokenPipeError:  # `bmask-slam info ... | head`: nobody reads on
        discard_output()
        return 128 + signal.SIGPIPE
    except (OSError, MemoryError, ImportError, RuntimeError) as error:
        return _after_refusal(error)
    except (KeyboardInterrupt, _Terminated) as ended:
        return _after_signal(ended)


def _run(argv: Sequence[str] | None) -> int:
    """Run one command, and write all that it has printed: the end of Python would hide errors."""
    try:
        arguments = make_parser().parse_args(argv)
    except SystemExit:  # after --help
        print(end="", flush=True)
        raise
    _check_memory()
    with _terminations(), _console_log(arguments):
        code = int(arguments.handler(arguments))
    print(end="", flush=True)
    return code


def _console_log(arguments: argparse.Namespace) -> AbstractContextManager[None]:
    """Warnings on stderr, with -v all that a run's log.txt gets.

    Not for the doctor, which looks for the libraries that this needs.
    """
    if arguments.command == "doctor":
        return nullcontext()
    from bmask_slam.runtime.progress import console_log

    return console_log(logging.INFO if arguments.verbose else logging.WARNING)


def _check_memory() -> None:
    """Raise InputError if a limit leaves too little memory for the libraries."""
    limit = memory_limit_bytes()
    if limit is not None and limit < MIN_MEMORY_BYTES:
        cure = f"this program needs {MIN_MEMORY_BYTES / 1e9:g} GB: ulimit -v unlimited"
        raise InputError(f"memory is limited to {limit / 1e9:.2g} GB (ulimit -v); {cure}")


def _after_refusal(error: Exception) -> int:
    """The exit status after what the machine refuses; another error is raised again."""
    if isinstance(error.__cause__, (KeyboardInterrupt, _Terminated)):  # while a library loaded
        return _after_signal(error.__cause__)
    if is_out_of_memory(error):
        return _fail(MEMORY)
    if not isinstance(error, OSError):
        raise error
    if error.errno == errno.EIO and is_terminal_closed():
        discard_output()
        return 128 + signal.SIGHUP
    if error.errno not in CURES:
        raise error
    name = error.filename2 or error.filename or "output"
    status = _fail(f"{name}: {error.strerror}; {CURES[error.errno]}")
    if error.filename is None and CURES[error.errno] is SPACE:
        discard_output()
    return status


class _Terminated(BaseException):
    """A signal that ends a process came where nothing waits for it, as during start-up."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number


def _after_signal(ended: KeyboardInterrupt | _Terminated) -> int:
    """The exit status after a signal, which is said."""
    text, number = "interrupted", signal.SIGINT
    if isinstance(ended, _Terminated):
        text, number = f"ended by {ended.number.name}", ended.number
    with suppress(OSError):
        print(text, file=sys.stderr)
    return 128 + number


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
    print(f"error: {one_line(message)}", file=sys.stderr)
    return 1


class _PrintCompletion(argparse.Action):
    """Prints the tab completion of a shell, and ends."""

    def __call__(self, parser: argparse.ArgumentParser, *given: Any) -> None:
        _, shell, _ = given
        shtab: Any = import_extra("shtab", "--print-completion", "completion")
        for command in _commands(parser).values():
            for action in command._actions:  # of a path the shell completes files
                if action.type is Path or action.metavar in ("F", "DIR", "RUN"):
                    action.complete = shtab.FILE  # type: ignore[attr-defined]
        print(shtab.complete(parser, shell))
        parser.exit()


class _Parser(argparse.ArgumentParser):
    """Says which command, option or choice was meant by a mistyped one."""

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse does."""
        found, rest = self.parse_known_args(args, namespace)
        if rest:
            command = _commands(self).get(found.command, self)
            known = command._option_string_actions
            near = did_you_mean(rest[0].partition("=")[0], known)
            command.error(f"unrecognized arguments: {' '.join(rest)}{near}")
        return found

    def error(self, message: str) -> NoReturn:
        """As argparse does."""
        if wrong := CHOICE.search(message):
            choices = [choice.strip(" '\"") for choice in wrong[2].split(",")]
            message += did_you_mean(wrong[1], choices)
        super().error(one_line(message))


def _commands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The parsers of the commands by name."""
    actions = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    return {name: command for action in actions for name, command in action.choices.items()}


def make_parser() -> argparse.ArgumentParser:
    """The parser of all commands; each stores its function as ``handler``."""
    parser: argparse.ArgumentParser = _Parser(
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
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, dest="command"
    )
    for add in ADDED:
        add(commands)
    for command in _commands(parser).values():
        text = "say on stderr what is done, as in log.txt"
        command.add_argument("-v", "--verbose", action="store_true", help=text)
    return parser
