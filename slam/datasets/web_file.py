"""Download of a file over HTTP: resumed, checked, and complete or absent."""

from __future__ import annotations

import hashlib
import http.client
import logging
import os
import shutil
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_text
from bmask_slam.graph.files.whole_file import open_plain, whole_file

CHUNK_BYTES = 1 << 20
TIMEOUT_S = 30.0
TRIES = 5
FIRST_PAUSE_S = 1.0
"""Pause before the second try; it doubles with each further one."""
PERMANENT = (400, 401, 403, 404, 410, 451)
"""HTTP status codes that another try will not change."""
RANGE_REFUSED = 416

logger = logging.getLogger(__name__)

Progress = Callable[[int, int], None]
"""Called with the bytes received and those of the whole file, 0 if unknown."""


@dataclass(frozen=True)
class WebFile:
    """A file on the web.

    Attributes:
        url: its address.
        sha256: its SHA-256 in hexadecimal, or the first digits; "" if unknown.
        size: its size in bytes; None if unknown.
    """

    url: str
    sha256: str = ""
    size: int | None = None


class _InterruptedError(Exception):
    """The connection ended before the end of the file."""


CONNECTION_ERRORS = (
    _InterruptedError,
    http.client.HTTPException,
    urllib.error.URLError,
    TimeoutError,
    ConnectionError,
)


def download(file: WebFile, path: Path, progress: Progress | None = None) -> str:
    """Download a file to ``path`` unless it is there already and correct; its SHA-256.

    Received bytes are kept as NAME.part; the next call resumes from there if the server supports
    it and its file is unchanged. Concurrent downloads to one folder run one after the other.

    Raises:
        InputError: no connection, another size or SHA-256, or too little disk space.
    """
    if not file.url.startswith(("https://", "http://")):
        raise InputError(f"{file.url[:100]}: no web address; give one of https")
    path.parent.mkdir(parents=True, exist_ok=True)
    with locked(path.parent):
        if path.is_file() and not _difference(file, path):
            return sha256(path)
        part = path.with_name(f"{path.name}.part")
        _complete(file, part, progress or (lambda done, total: None))
        difference = _difference(file, part)
        if difference:
            _remove_part(part)
            raise InputError(
                f"{file.url}: {difference}: the file was damaged in transfer or has been replaced; "
                f"try again, or {_by_hand(part)}"
            )
        os.replace(part, path)
        _remove_part(part)
        return sha256(path)


def sha256(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _difference(file: WebFile, path: Path) -> str:
    """How a file on disk differs from the expected size and SHA-256; "" if it does not."""
    size = path.stat().st_size
    if file.size is not None and size != file.size:
        return f"{size} bytes, not {file.size}"
    found = sha256(path) if file.sha256 else ""
    if not found.startswith(file.sha256):
        return f"the SHA-256 begins with {found[: len(file.sha256)]}, not {file.sha256}"
    return ""


def _complete(file: WebFile, part: Path, progress: Progress) -> None:
    """Receive until the file is complete; give up after TRIES failures without progress."""
    failures = 0
    while True:
        before = _size(part)
        try:
            return _receive(file, part, progress)
        except (_InterruptedError, http.client.HTTPException, OSError) as error:
            if not isinstance(error, CONNECTION_ERRORS):
                raise  # an error of the disk
            failures = 1 if _size(part) > before else failures + 1
            if failures == TRIES or _is_permanent(error):
                raise _failed(file, part, error) from error
            pause_s = FIRST_PAUSE_S * 2 ** (failures - 1)
            logger.warning("%s: %s; trying again in %g s", file.url, _reason(error), pause_s)
            time.sleep(pause_s)


def _is_permanent(error: Exception) -> bool:
    """Whether another try would fail too: no such file, no such server, connection refused."""
    if isinstance(error, urllib.error.HTTPError):
        return error.code in PERMANENT
    return isinstance(getattr(error, "reason", error), (socket.gaierror, ConnectionRefusedError))


def _reason(error: Exception) -> str:
    if isinstance(error, urllib.error.HTTPError):
        return f"{error.code} {error.reason}"
    return str(getattr(error, "reason", error)) or type(error).__name__


def _by_hand(part: Path) -> str:
    return f"fetch it by other means and put it to {part.with_suffix('')}"


def _failed(file: WebFile, part: Path, error: Exception) -> InputError:
    size = _size(part)
    kept = f"; {size} bytes are kept, the same command resumes from there" if size else ""
    return InputError(
        f"{file.url}: cannot be downloaded ({_reason(error)}){kept}; {_by_hand(part)}"
    )


def _receive(file: WebFile, part: Path, progress: Progress) -> None:
    """Append the rest of the file to the part, or start again if the server cannot resume."""
    request = urllib.request.Request(file.url)
    mark, begin = _mark_file(part), _size(part)
    if begin and mark.is_file():
        request.add_header("Range", f"bytes={begin}-")
        request.add_header("If-Range", " ".join(read_text(mark, "remove it").split()))
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT_S)  # nosec B310 # see download
    except urllib.error.HTTPError as error:
        if error.code != RANGE_REFUSED:
            raise
        if error.headers.get("Content-Range") == f"bytes */{begin}":
            return  # it was complete already
        _remove_part(part)  # it is longer than the server's file
        raise _InterruptedError("the part on disk does not belong to the file") from error
    with response:
        begin = begin if _continues(response, begin) else 0
        length = response.headers.get("Content-Length")
        total = begin + int(length) if length and length.isdigit() else file.size or 0
        _check_room(file, part, total)
        _write_mark(response.headers, mark)
        with open_plain(part, "r+b" if begin else "wb") as out:
            out.seek(begin)
            done = _copy(response, out, begin, total, progress)
    if done < total:
        raise _InterruptedError(f"the connection ended after {done} of {total} bytes")


def _continues(response: http.client.HTTPResponse, begin: int) -> bool:
    """Whether a response begins where the part on disk ends."""
    stated = response.headers.get("Content-Range", "")
    return response.status == http.HTTPStatus.PARTIAL_CONTENT and f"bytes {begin}-" in stated


def _copy(source: IO[bytes], out: IO[bytes], done: int, total: int, progress: Progress) -> int:
    """Copy to the end; returns the bytes in ``out``."""
    while chunk := _next_chunk(source):
        out.write(chunk)
        done += len(chunk)
        progress(done, total)
    return done


def _next_chunk(source: IO[bytes]) -> bytes:
    """The next bytes of a connection, whose errors are then told from those of the disk."""
    try:
        return source.read(CHUNK_BYTES)
    except OSError as error:  # such as a TLS record that is damaged, or a network that went away
        raise _InterruptedError(str(error) or type(error).__name__) from error


def _check_room(file: WebFile, part: Path, total: int) -> None:
    """Refuse a file of another size, or without enough disk space, before receiving it."""
    if file.size is not None and total not in (0, file.size):
        raise InputError(
            f"{file.url}: {total} bytes, not {file.size}: another file; {_by_hand(part)}"
        )
    free, needed = shutil.disk_usage(part.parent).free, total - _size(part)
    if needed > free:
        raise InputError(
            f"{part.parent}: {free / 1e9:.2f} GB free, {needed / 1e9:.2f} GB of {file.url} are "
            "still to come; free some space or choose another folder"
        )


def _write_mark(headers: http.client.HTTPMessage, mark: Path) -> None:
    """Store the version of the server's file (ETag or date), which resuming needs."""
    strong = headers.get("ETag", "")
    known = strong if strong and not strong.startswith("W/") else headers.get("Last-Modified", "")
    if known:
        with whole_file(mark) as temporary:
            temporary.write_text(known, encoding="utf-8")
    else:
        mark.unlink(missing_ok=True)


def _mark_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.mark")


def _remove_part(part: Path) -> None:
    part.unlink(missing_ok=True)
    _mark_file(part).unlink(missing_ok=True)


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold a lock of the folder, where the system has locks."""
    try:
        import fcntl  # noqa: PLC0415 - Unix only
    except ImportError:
        yield
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)
