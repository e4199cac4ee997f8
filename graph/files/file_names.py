"""Names of files that stand in files: they may not lead out of their folder."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from bmask_slam.graph.errors import InputError

MAX_NAME_BYTES = 255
MAX_PATH_BYTES = 1024


def is_inside(name: str) -> bool:
    """Whether ``check_name`` accepts a name."""
    return not _fault(name)


def check_name(name: str, where: str) -> str:
    """A path relative to the folder of the file that names it, as it was given.

    What a recording is made of may be links to elsewhere, which the user made; a name in a list
    comes from a stranger.

    Raises:
        InputError: the name is empty, absolute, too long, has ``..`` or a NUL in it; ``where``
            says where it stands.
    """
    fault = _fault(name)
    if fault:
        raise InputError(f"{where}: {name[:60]!r} {fault}; name it relative to the file's folder")
    return name


def _fault(name: str) -> str:
    """What is wrong with a name; "" for a good one."""
    path = PurePosixPath(name.replace("\\", "/"))
    parts = [part.encode(errors="surrogatepass") for part in path.parts]
    if not parts or "\0" in name:
        return "is no file name"
    if path.is_absolute() or ".." in path.parts or ":" in path.parts[0]:
        return "leads out of the folder"
    if max(map(len, parts)) > MAX_NAME_BYTES or sum(map(len, parts)) > MAX_PATH_BYTES:
        return "is too long for a file name"
    return ""


def file_stem(name: str) -> str:
    """A class name or the like as a part of a file's name: letters, digits and ``_ . -``."""
    return re.sub(r"[^\w.-]+", "_", name)[:80]


def is_folder(path: Path) -> bool:
    """Whether a path that stands in a file leads to a folder; not if no file can have that name."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def refuse_link(path: Path, cure: str = "remove it") -> None:
    """Raise InputError if a file or folder that would be written to is a link."""
    if path.is_symlink():
        raise InputError(f"{path}: is a link; nothing is written through it, {cure}")


def target_below(root: Path, name: str) -> Path:
    """A path below ``root`` to write a file to; its folder is made, see ``plain_path``."""
    path = plain_path(root, name)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def plain_path(root: Path, name: str) -> Path:
    """A path below ``root`` without links on the way to it.

    Raises:
        InputError: the name leads out of ``root``, or a folder on the way is a link.
    """
    path = root / check_name(name, str(root))
    for folder in reversed(path.relative_to(root).parents):
        if folder.parts:
            refuse_link(root / folder)
    return path
