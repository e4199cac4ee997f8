"""Unpacking archives that nobody vouches for: only plain files and folders, inside the folder."""

from __future__ import annotations

import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from bmask_slam.graph.errors import InputError

Progress = Callable[[int, int], None]
"""Called with the bytes of the archive that are read and all of them."""


def unpack(archive: Path, folder: Path, progress: Progress | None = None) -> None:
    """Unpack a tar (of any compression) or zip archive to a folder, which must be empty.

    Owners, rights and times of the archive are not taken over.

    Raises:
        InputError: no archive, a broken one, or one that holds a link, a device, an absolute path,
            ".." or a name twice. What was unpacked by then is left in the folder.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _readable(archive):
        if zipfile.is_zipfile(archive):
            _unpack_zip(archive, folder, progress or _ignore)
        else:
            _unpack_tar(archive, folder, progress or _ignore)


def _unpack_tar(archive: Path, folder: Path, progress: Progress) -> None:
    size = archive.stat().st_size
    with archive.open("rb") as raw, tarfile.open(fileobj=raw, mode="r:*") as tar:
        for member in tar:
            path = _place(archive, member.name, folder)
            if member.isdir():
                path.mkdir(parents=True, exist_ok=True)
                continue
            content = tar.extractfile(member) if member.isreg() else None
            if content is None:
                raise InputError(f"{archive}: holds {member.name!r}, a link or device: refused")
            _write(archive, path, content)
            progress(raw.tell(), size)


def _unpack_zip(archive: Path, folder: Path, progress: Progress) -> None:
    with zipfile.ZipFile(archive) as held:
        total, done = sum(info.compress_size for info in held.infolist()), 0
        for info in held.infolist():
            path = _place(archive, info.filename, folder)
            kind = stat.S_IFMT(info.external_attr >> 16)
            if info.is_dir():
                path.mkdir(parents=True, exist_ok=True)
            elif kind not in (0, stat.S_IFREG):
                raise InputError(f"{archive}: holds {info.filename!r}, a link or device: refused")
            else:
                with held.open(info) as content:
                    _write(archive, path, content)
            done += info.compress_size
            progress(done, total)


def _place(archive: Path, name: str, folder: Path) -> Path:
    """Where a member belongs; nothing may leave the folder."""
    parts = PurePosixPath(name).parts
    if not name or name.startswith("/") or ".." in parts or "\\" in name or ":" in name[:2]:
        raise InputError(f"{archive}: holds {name!r}, which leads out of its folder: refused")
    return folder.joinpath(*parts)


def _write(archive: Path, path: Path, content: IO[bytes]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with path.open("xb") as file:
            shutil.copyfileobj(content, file, 1 << 20)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{archive}: holds {path.name!r} twice: refused") from error


@contextmanager
def _readable(archive: Path) -> Iterator[None]:
    """Say of a broken archive which it is."""
    broken = (tarfile.TarError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError)
    try:
        yield
    except broken as error:
        raise InputError(
            f"{archive}: not an archive, or a broken one ({error}); remove it and download again"
        ) from error


def _ignore(done: int, total: int) -> None:
    """No progress is wanted."""
