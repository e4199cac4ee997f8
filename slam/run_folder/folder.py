"""The run folder: files that other tools read, complete after a run and usable during it.

====================  ============================================================================
config.yaml           the resolved configuration; ``--config RUN/config.yaml`` repeats it
trajectory.txt        TUM format, T_world_camera, every frame with a pose
trajectory_segment_N  .txt: the same of map segment N, if it was never joined to the largest
keyframes.txt         the keyframes, as trajectory.txt
frames.csv            one line a frame: status, matches, inliers, milliseconds a stage, keyframe
events.csv            one line for what happened: lost, found again, segments, loops, the graph
landmarks.ply         x y z (world, metres), red green blue, observations, id
graph                 the saved factor graph and values, one file that loads again
map                   keyframes, landmarks and graph, for ``run --continue`` and ``run --localise``
labels.csv            with a segmenter: label, probability, entropy, views of every landmark
objects.json, .ply    with a segmenter: objects with label, box, keyframes; the boxes as lines
objects.png           with a segmenter: landmarks by label and objects, from above
dense/                with ``--map``, run or live, or by ``bmask-slam map``: `dense.folder`
covariances.txt       with ``--covariances``: of every keyframe's pose, see
                      `run_folder.covariance_file`
metrics.json          a list of {"name", "value", "unit"}
trajectory.png        top view with marks of events, and errors against the reference
log.txt               the log
camera.yaml           the camera of the run, where readout time or delay were found and adopted;
                      or what ``bmask-slam calibrate`` found
recordings.json       of a merged run: its recordings, and what was added to their stamps
trajectory_run_N.txt  of a merged run: the frames of the Nth run, with its own stamps
report.html, film.gif after ``bmask-slam report`` and ``film``: a web page, a short film
health.json           of a live run: rates, delays, queues, what was dropped, every second
markers.json          with ``--markers``: pose, size and sightings of each fiducial marker
checkpoint            with ``--checkpoint-every``, until the run ends: ``--resume`` goes on there
====================  ============================================================================

``frames.csv``, ``events.csv`` and ``log.txt`` grow line by line; everything else is written under a
temporary name and renamed, so that a killed run leaves complete files.
"""

from __future__ import annotations

import errno
import logging
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from types import TracebackType

from bmask_slam.evaluation.recordings import JOINED
from bmask_slam.events import EVENT_COLUMNS, EVENTS, Event, event_row
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_lock import lock_file
from bmask_slam.graph.files.file_names import refuse_link
from bmask_slam.graph.files.growing_table import check_grown
from bmask_slam.graph.files.whole_file import remove, remove_partial, whole_file, writing
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.run_folder.covariance_file import COVARIANCES
from bmask_slam.run_folder.frame_file import COLUMNS, FRAMES, frame_row
from bmask_slam.run_folder.landmark_file import MARKERS
from bmask_slam.run_folder.open_files import LOG, OpenFiles
from bmask_slam.run_folder.semantic_files import SEMANTIC_FILES
from bmask_slam.runtime.memory import is_out_of_memory
from bmask_slam.sequences.formats.layouts import is_recording_folder
from bmask_slam.tracking.results import FrameResult

FILES = (
    *("config.yaml", "trajectory.txt", "keyframes.txt", FRAMES, EVENTS, "landmarks.ply"),
    *("graph", "map", "metrics.json", "trajectory.png", LOG),
)
CAMERA, CHECKPOINT = "camera.yaml", "checkpoint"
DENSE, HEALTH = "dense", "health.json"
REPORT, FILM = "report.html", "film.gif"
SOMETIMES = (
    *(CHECKPOINT, CAMERA, COVARIANCES, HEALTH, JOINED, MARKERS, REPORT, FILM),
    *SEMANTIC_FILES,
)
OTHER_PATHS = re.compile(r"trajectory_(segment|run)_\d+\.txt")
ELSEWHERE = "choose another folder with --out"
DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
LOGGERS = ("bmask_slam",)
GROWING = {FRAMES: COLUMNS, EVENTS: EVENT_COLUMNS}
"""The files that grow by lines with these columns."""


def trajectory_files(run: Path) -> list[Path]:
    """trajectory.txt of a run folder, then the file of each other map segment, by number."""
    others = run.glob("trajectory_segment_*.txt")
    return [run / "trajectory.txt", *sorted(others, key=lambda file: (len(file.name), file.name))]


class RunFolder:
    """An open run folder; a context manager that closes its files.

    If anything but a bug ends the block before the first frame, the folder is removed again. While
    it is open, no other process can write a run there.
    """

    def __init__(
        self, path: Path, overwrite: bool = False, resume_bytes: Mapping[str, int] | None = None
    ) -> None:
        """Make the folder with files that grow, still empty, or reopen it to resume its run.

        To resume, frames.csv and events.csv are cut to ``resume_bytes``, by name.

        Raises:
            InputError: it cannot be written, another process writes there, it holds a run and
                ``overwrite`` is not set, or a file does not belong to the run to resume.
        """
        self._keep = resume_bytes is not None
        self._made = [] if self._keep else _make_folder(path)
        kept = resume_bytes or {}
        if resume_bytes is None:
            _clear(path, overwrite)
        else:
            for name in (*GROWING, LOG):
                refuse_link(path / name, "start the run again with --overwrite")
        for name, size in kept.items():
            check_grown(path / name, GROWING[name], size)
        with writing(path, ELSEWHERE), self._unmade_on_error():
            self._files = OpenFiles(path, GROWING, "a" if self._keep else "x")
            self._tables, self._log = self._files.tables, self._files.log
            with self._files.undone_on_error():
                self._tables[FRAMES].lock(path)
                for name, table in self._tables.items():
                    table.begin(kept.get(name, 0))
                remove_partial(path)
        self._levels: dict[str, int] = {}

    @contextmanager
    def _unmade_on_error(self) -> Iterator[None]:
        """Where nothing can be written, the empty folders that were made are removed again."""
        try:
            yield
        except OSError:
            _remove_empty(self._made)
            raise

    @property
    def path(self) -> Path:
        """The folder; another one from when that was renamed or removed, see `OpenFiles.follow`."""
        return self._files.follow()

    @property
    def last_path(self) -> Path:
        """The folder as it was last found, without looking whether it is still there."""
        return self._files.path

    def __enter__(self) -> RunFolder:
        self._log.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        for name in LOGGERS:
            logger = logging.getLogger(name)
            self._levels[name] = logger.level
            logger.setLevel(logging.INFO)
            logger.addHandler(self._log)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if error is not None:
            details = None if isinstance(error, InputError) else (type(error), error, traceback)
            self._log.handle(
                logging.LogRecord(
                    __name__, logging.ERROR, __file__, 0, "stopped: %s", (error,), details
                )
            )
        for name, level in self._levels.items():
            logging.getLogger(name).removeHandler(self._log)
            logging.getLogger(name).setLevel(level)
        try:
            self._files.close()
        except OSError as unwritten:
            error = error or unwritten
        if error is not None and not self._keep and not _is_bug(error):
            _remove(self.last_path, (*SOMETIMES, *FILES))
            _remove_empty(self._made)
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            cure = "free some space" if error.errno != errno.EROFS else "make it writable again"
            text = f"{error.strerror}; {cure}, what was written before is kept"
            raise InputError(f"{self.last_path}: {text}") from error

    def write_frame(self, result: FrameResult) -> None:
        """Append a frame to frames.csv, and its events to events.csv; both are flushed.

        Raises:
            ValueError: ``stage_ms`` has an unknown stage.
        """
        self._files.follow()
        self._tables[FRAMES].append([frame_row(result)])
        self.write_events(result.events)
        self._keep = True

    def write_events(self, events: Iterable[Event]) -> None:
        """Append to events.csv what happened before the first frame or after the last one."""
        self._tables[EVENTS].append(map(event_row, events))

    def synced_bytes(self) -> dict[str, int]:
        """Write the files that grow to disk; their sizes in bytes by name."""
        return {name: table.synced_bytes() for name, table in self._tables.items()}

    @property
    def empty_bytes(self) -> dict[str, int]:
        """Sizes in bytes by name of the files that grow, with nothing in them but the header."""
        return {name: len(",".join(columns).encode()) + 1 for name, columns in GROWING.items()}

    def write_rows(self, name: str, rows: Iterable[dict[str, object]]) -> None:
        """Append lines to frames.csv or events.csv, which come from another run."""
        self._tables[name].append(rows)

    def begin_anew(self) -> None:
        """Take back all frames and events: the run begins with its first frame again."""
        for name, size in self.empty_bytes.items():
            self._tables[name].begin(size)

    def complete(self) -> None:
        """Mark the run as finished by removing its checkpoint."""
        self._files.write_missing_texts()
        _remove(self.path, [CHECKPOINT])

    def write_trajectory(self, trajectory: Trajectory, name: str = "trajectory.txt") -> None:
        """Replace trajectory.txt, or the file ``name``, by the poses T_world_camera."""
        self.written(lambda path: write_tum(path / name, trajectory))

    def write_text(self, name: str, text: str) -> None:
        """Replace a text file, which is written again if it is removed during the run."""
        self._files.texts[name] = text
        self.write_file(name, lambda path: path.write_text(text, encoding="utf-8"))

    def remove_text(self, name: str) -> None:
        """Take back a text file, if there is one."""
        self._files.texts.pop(name, None)
        remove(self.path / name)

    def write_file(self, name: str, write: Callable[[Path], object]) -> None:
        """Replace a file by what a function writes to another path."""

        def replace(path: Path) -> None:
            with whole_file(path / name) as temporary:
                write(temporary)

        self.written(replace)

    def written(self, write: Callable[[Path], None]) -> None:
        """Let a function write into the folder; once more if that was moved in the meantime."""
        path = self.path
        try:
            write(path)
        except (OSError, InputError):
            if self.path == path:
                raise
            write(self.path)


def _clear(path: Path, overwrite: bool) -> None:
    """Remove the run in a folder, its checkpoint first. Raises InputError."""
    if is_recording_folder(path):
        raise InputError(f"{path}: is a sequence, not a run; choose another --out")
    held = [name for name in (*SOMETIMES, *FILES) if os.path.lexists(path / name)]
    if held and not overwrite:
        cure = "go on with --resume, " if held[0] == CHECKPOINT else ""
        raise InputError(
            f"{path}: already holds a run ({held[0]}); {cure}choose another --out or add "
            "--overwrite"
        )
    with writing(path, ELSEWHERE), ExitStack() as opened:
        if (path / FRAMES).is_file():
            lock_file(opened.enter_context((path / FRAMES).open("rb")), path)
        others = [f.name for f in path.iterdir() if OTHER_PATHS.fullmatch(f.name)]
        _remove(path, [*held, DENSE, *others] if held else [])


def _make_folder(path: Path) -> list[Path]:
    """Make a folder and its parents; returns those that were made, the innermost first."""
    missing = [folder for folder in (path, *path.parents) if not folder.exists()]
    with writing(path, ELSEWHERE):
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError as error:
            raise InputError(f"{path}: is a file; {ELSEWHERE}") from error
    return missing


def _is_bug(error: BaseException) -> bool:
    """Whether the log with its traceback may be needed: not after bad input, a signal, a limit."""
    is_outside = isinstance(error, (InputError, OSError)) or is_out_of_memory(error)
    return isinstance(error, Exception) and not is_outside


def _remove_empty(folders: Iterable[Path]) -> None:
    """Remove these folders, given from the innermost on, while they are empty."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _remove(folder: Path, names: Iterable[str]) -> None:
    """Remove the files and folders that exist."""
    for name in names:
        remove(folder / name)
