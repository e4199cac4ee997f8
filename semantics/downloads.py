"""Weight files from the network: checked, and kept for the next time."""

from __future__ import annotations

import os
import re
from pathlib import Path

from bmask_slam.semantics.http_file import WebFile, download


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
    download(WebFile(url, expected_sha256(path.name)), path)
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
