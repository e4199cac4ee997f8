"""Progress bars with rate, status and keyframes, and log messages above them."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from tqdm import tqdm

from bmask_slam.graph.errors import one_line
from bmask_slam.tracking.results import TrackingStatus

tqdm.set_lock(threading.RLock())  # its own is for processes, and may start one

TERMINAL_INTERVAL_S = 0.1
FILE_INTERVAL_S = 10.0


def make_bar(total: int | None, quiet: bool, done: int = 0) -> tqdm:
    """A bar on stderr: a line every 10 s if that is no terminal, nothing if quiet."""
    interval_s = TERMINAL_INTERVAL_S if sys.stderr.isatty() else FILE_INTERVAL_S
    return tqdm(
        total=total,
        initial=done,
        disable=quiet,
        unit="frame",
        mininterval=interval_s,
        maxinterval=interval_s,
        dynamic_ncols=True,
    )


@contextmanager
def counting_bar(quiet: bool) -> Iterator[Callable[[int, int], None]]:
    """A function ``(done, total)`` that moves a bar."""
    with make_bar(None, quiet) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


@contextmanager
def byte_bars(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A function ``(what, done, total)`` that moves a bar of bytes, one for each ``what``."""
    bars: dict[str, tqdm] = {}

    def show(what: str, done: int, total: int) -> None:
        if what not in bars:
            bars[what] = make_bar(total or None, quiet, done)
            bars[what].unit, bars[what].unit_scale = "B", True
            bars[what].set_description(what, refresh=False)
        bars[what].total = total or None
        bars[what].update(done - bars[what].n)

    try:
        yield show
    finally:
        for bar in bars.values():
            bar.close()


@contextmanager
def iteration_bar(quiet: bool) -> Iterator[Callable[[int, float], None]]:
    """A function ``(iteration, cost)`` that shows both, only on a terminal."""
    with tqdm(unit="step", disable=quiet or not sys.stderr.isatty()) as bar:

        def show(iteration: int, cost: float) -> None:
            bar.set_postfix_str(f"cost {cost:.6g}", refresh=False)
            bar.update(iteration - bar.n)

        yield show


class Progress:
    """The bar of a run, of which ``done`` frames may be done already."""

    def __init__(self, total: int, quiet: bool, done: int = 0) -> None:
        self._bar = make_bar(total, quiet, done)

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def update(self, status: TrackingStatus, keyframes: int, lost: int) -> None:
        """Count a frame; show its status and the counters."""
        text = f"{status.value}, {keyframes} keyframes, {lost} lost"
        self._bar.set_postfix_str(text, refresh=False)
        self._bar.update()


class _BarHandler(logging.Handler):
    """Writes log records above the bar; nothing once the terminal is closed."""

    def emit(self, record: logging.LogRecord) -> None:
        with suppress(OSError):
            tqdm.write(one_line(self.format(record)), file=sys.stderr)


@contextmanager
def console_log(level: int = logging.WARNING) -> Iterator[None]:
    """Show log records from ``level`` on stderr, above the bar; INFO only those of this package."""
    handler = _BarHandler(level)
    handler.setFormatter(logging.Formatter("%(levelname)s: %(message)s"))
    root, own = logging.getLogger(), logging.getLogger("bmask_slam")
    root.addHandler(handler)
    before = own.level
    if level < logging.WARNING:
        own.setLevel(level)
    try:
        yield
    finally:
        own.setLevel(before)
        root.removeHandler(handler)
