"""The files of a run that grow, in a folder that may be renamed or removed while it is written.

Files that are open are written on after their folder was renamed, and even after they were removed:
then into nothing that has a name. The folder is therefore held open, looked for before anything is
written, and made again with all that was written so far if it is gone.
"""

from __future__ import annotations

import itertools
import logging
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.growing_table import NO_TEXT, GrowingTable, written_again
from bmask_slam.graph.files.whole_file import whole_file

logger = logging.getLogger(__name__)

LOG = "log.txt"


def free_run_path(stem: str, root: Path = Path("runs")) -> Path:
    """``root/stem``, or with -2, -3, ... the first that does not exist yet."""
    names = itertools.chain([stem], (f"{stem}-{n}" for n in itertools.count(2)))
    return next(root / name for name in names if not os.path.lexists(root / name))


class LogFile(logging.FileHandler):
    """A log file that ignores its own OSErrors: a full disk is reported where data are written."""

    def handleError(self, record: logging.LogRecord) -> None:
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)

    @property
    def is_removed(self) -> bool:
        """Whether the file has no name any more."""
        return self.stream is not None and os.fstat(self.stream.fileno()).st_nlink == 0

    def restore(self, path: Path) -> None:
        """Write what was logged to a new file, and go on there; OSError: there is none then."""
        self.acquire()
        try:
            if (old := self.stream) is not None:
                self.stream, self.baseFilename = written_again(old, path), os.path.abspath(path)
                old.close()
        finally:
            self.release()


class OpenFiles:
    """The open files of a run folder, and its small texts.

    Attributes:
        path: the folder, as it was last found.
        tables: the tables that grow, by name.
        log: the log file.
        texts: files that are written again if they are removed, by name.
    """

    def __init__(self, path: Path, columns: Mapping[str, tuple[str, ...]], mode: str) -> None:
        """Open tables with these columns and the log; ``mode`` "x": new, "a": to go on.

        Raises:
            OSError: one of them cannot be written, or a new one is there already; none was made.
        """
        self.path = path
        self.texts: dict[str, str] = {}
        self.tables: dict[str, GrowingTable] = {}
        self._files: dict[str, GrowingTable | LogFile] = {}
        self._directory: int | None = None
        self._is_new, self._is_open = mode == "x", True
        with self.undone_on_error():
            for name, names in columns.items():
                self._files[name] = self.tables[name] = GrowingTable(path / name, names, mode)
            log = LogFile(path / LOG, mode=f"{mode}+", encoding="utf-8", errors=NO_TEXT)
            self._files[LOG] = self.log = log
            self._directory = _descriptor(path)

    def follow(self) -> Path:
        """The folder's present path, after its tables, log and texts were written again if needed.

        Where the folder was removed it is made again, or one beside it if there is another now.

        Raises:
            OSError: it cannot be written.
        """
        if not self._is_open or (self._is_here() and not self._removed()):
            return self.path
        before = self.path
        if not self._is_here():
            self.path = _path_of(self._directory) or self._made_again()
        if self._removed():
            self._restore()
            text = "%s: was removed while the run is written there; written again to %s"
        else:
            text = "%s: was renamed while the run is written there; now %s"
        logger.warning(text, before, self.path)
        return self.path

    def close(self) -> None:
        """Close all files. Raises OSError if what is not written yet cannot be."""
        self._is_open = False
        if self._directory is not None:
            os.close(self._directory)
            self._directory = None
        error = None
        for file in reversed(self._files.values()):
            try:
                file.close()
            except OSError as unwritten:
                error = error or unwritten
        if error is not None:
            raise error

    @contextmanager
    def undone_on_error(self) -> Iterator[None]:
        """Close all files if the block raises an error; new ones are removed, no one else's are."""
        try:
            yield
        except (OSError, InputError):
            new = self._files.items() if self._is_new else ()
            made = [self.path / name for name, file in new if not file.is_removed]
            with suppress(OSError):
                self.close()
            for path in made:
                path.unlink(missing_ok=True)
            raise

    def write_missing_texts(self) -> None:
        """Write the texts that are not there, removed or not written because the disk was full."""
        for name, text in self.texts.items():
            if not (self.path / name).exists():
                with whole_file(self.path / name) as temporary:
                    temporary.write_text(text, encoding="utf-8")

    def _is_here(self) -> bool:
        try:
            found = os.stat(self.path)
        except (FileNotFoundError, NotADirectoryError):
            return False
        return self._directory is None or os.path.samestat(found, os.fstat(self._directory))

    def _removed(self) -> list[str]:
        """Names of the open files that were removed, and in whose place there is no other one."""
        removed = (name for name, file in self._files.items() if file.is_removed)
        return [name for name in removed if not os.path.lexists(self.path / name)]

    def _made_again(self) -> Path:
        """A new folder in the place of one that was removed, or beside what is there now."""
        path = free_run_path(self.path.name, self.path.parent)
        path.mkdir(parents=True)
        if self._directory is not None:
            os.close(self._directory)
            self._directory = _descriptor(path)
        return path

    def _restore(self) -> None:
        for name in self._removed():
            self._files[name].restore(self.path / name)
        self.write_missing_texts()


def _descriptor(path: Path) -> int | None:
    """The folder held open; None on Windows, where one with open files cannot be renamed."""
    return None if sys.platform == "win32" else os.open(path, os.O_RDONLY)


def _path_of(directory: int | None) -> Path | None:
    """Where an open directory is now; None if it was removed, or the system does not say."""
    with suppress(OSError):
        path = Path(os.readlink(f"/proc/self/fd/{directory}"))
        if directory is not None and os.path.samestat(path.stat(), os.fstat(directory)):
            return path
    return None
