"""Weight files from the network: checked, and kept for the next time."""

from __future__ import annotations

import hashlib
import os
import re
import urllib.error
import urllib.request
import uuid
from pathlib import Path

from graph.errors import InputError

CHUNK_BYTES = 1 << 20
TIMEOUT_S = 30.0


def cache_folder() -> Path:
    """Where downloaded weights are kept: $XDG_CACHE_HOME/bmask-slam, or ~/.cache/bmask-slam."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "bmask-slam"


def fetch(url: str, folder: Path) -> Path:
    """The file of a URL in ``folder``, downloaded unless it is there already and whole.

    The end of the file's name is the beginning of its SHA-256 (name-0123abcd.pth); a file that
    does not agree is never kept.

    Raises:
        InputError: no connection, or a file with another SHA-256.
    """
    path = folder / url.rsplit("/", 1)[-1]
    expected = expected_sha256(path.name)
    if path.is_file() and sha256(path).startswith(expected):
        return path
    temporary = folder / f".{path.name}.{uuid.uuid4().hex[:8]}.part"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _download(url, temporary)
        found = sha256(temporary)
        if not found.startswith(expected):
            raise InputError(
                f"{url}: the SHA-256 begins with {found[: len(expected)]}, not {expected}: "
                "the file was changed on the way; try again, or give a local file"
            )
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def expected_sha256(name: str) -> str:
    """The beginning of the SHA-256 that a file's name ends in.

    Raises:
        ValueError: a name without one.
    """
    match = re.search(r"-([0-9a-f]{8,64})\.\w+$", name)
    if match is None:
        raise ValueError(f"{name}: no SHA-256 at the end of the name")
    return match[1]


def sha256(path: Path) -> str:
    """The SHA-256 of a file in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _download(url: str, path: Path) -> None:
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response, path.open("wb") as file:
            while chunk := response.read(CHUNK_BYTES):
                file.write(chunk)
    except (urllib.error.URLError, TimeoutError, ConnectionError) as error:
        raise InputError(
            f"{url}: cannot be downloaded ({getattr(error, 'reason', error)}); "
            "download it elsewhere and give the file's path"
        ) from error
