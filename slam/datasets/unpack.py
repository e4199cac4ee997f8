"""Unpacking of downloaded archives: only plain files and folders, only inside the target folder."""

from __future__ import annotations

import errno
import lzma
import stat
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import is_inside
from bmask_slam.graph.files.reading import check_unpacked, in_short

MAX_HEADER_BYTES = 1 << 20
Progress = Callable[[int, int], None]
"""Called with the bytes of the archive that are read and all of them."""


def unpack(archive: Path, folder: Path, progress: Progress | None = None) -> None:
    """Unpack a tar (of any compression) or zip archive to a folder, which must be empty.

    Owners, permissions and times are not restored.

    Raises:
        InputError: no archive, a broken one, one that unpacks to more than a hundred times its
            size, or one that holds a link, a device, an absolute path, ".." or a name twice. What
            was unpacked by then is left in the folder.
    """
    if not archive.is_file():
        raise InputError(f"{archive}: is no file; give an archive")
    folder.mkdir(parents=True, exist_ok=True)
    unpack_kind = _unpack_zip if zipfile.is_zipfile(archive) else _unpack_tar
    with _archive_errors(archive):
        unpack_kind(archive, folder, progress or (lambda done, total: None))


class _Member(tarfile.TarInfo):
    """A member whose headers, which are read into memory, are of bounded size."""

    def _proc_member(self, tar: tarfile.TarFile) -> tarfile.TarInfo:
        if self.size > MAX_HEADER_BYTES and not (self.isreg() or self.isdir()):
            raise tarfile.ReadError(f"a header of {self.size} bytes")
        return super()._proc_member(tar)  # type: ignore[misc]


def _unpack_tar(archive: Path, folder: Path, progress: Progress) -> None:
    size, unpacked = archive.stat().st_size, 0
    with (
        archive.open("rb") as raw,
        tarfile.open(fileobj=raw, mode="r:*", tarinfo=_Member) as tar,
    ):
        for member in tar:
            _check(archive, member.name, member.isreg() or member.isdir(), folder)
            unpacked += member.size
            check_unpacked(unpacked, size)
            tar.extract(member, folder, set_attrs=False, filter="data")
            progress(raw.tell(), size)


def _unpack_zip(archive: Path, folder: Path, progress: Progress) -> None:
    with zipfile.ZipFile(archive) as zipped:
        total, done = sum(info.compress_size for info in zipped.infolist()), 0
        check_unpacked(sum(i.file_size for i in zipped.infolist()), archive.stat().st_size)
        for info in zipped.infolist():
            kind = stat.S_IFMT(info.external_attr >> 16)
            _check(archive, info.filename, kind in (0, stat.S_IFREG, stat.S_IFDIR), folder)
            zipped.extract(info, folder)
            done += info.compress_size
            progress(done, total)


def _check(archive: Path, name: str, plain: bool, folder: Path) -> None:
    """Refuse a member that is no plain file or folder, leaves ``folder``, or is there already.

    The libraries would rename members with an absolute path and overwrite those that come twice.
    """
    if not is_inside(name) or "\\" in name:
        raise InputError(f"{archive}: holds {name[:60]!r}, which leads out of its folder: refused")
    if not plain:
        raise InputError(f"{archive}: holds {name[:60]!r}, a link or device: refused")
    if (folder / name).is_file():
        raise InputError(f"{archive}: holds {name[:60]!r} twice: refused")


@contextmanager
def _archive_errors(archive: Path) -> Iterator[None]:
    """Name the archive in the libraries' errors."""
    broken = (tarfile.TarError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError)
    wrong = (RuntimeError, ValueError, LookupError, struct.error, OverflowError)
    try:
        yield
    except (FileExistsError, NotADirectoryError, IsADirectoryError) as error:
        raise InputError(f"{archive}: holds a file and a folder of one name: refused") from error
    except (*broken, *wrong, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, errno.EINVAL):
            raise  # of the disk
        raise InputError(
            f"{archive}: not an archive, or a broken one ({in_short(error)}); remove it and "
            "download again"
        ) from error
