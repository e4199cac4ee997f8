"""Published network weights by name: downloaded once, checked, and kept in a cache folder."""

from __future__ import annotations

import os
import re
from pathlib import Path

from bmask_slam.datasets.web_file import WebFile, download
from bmask_slam.graph.errors import InputError

PREFIX = "torchvision:"
PUBLISHED = {
    "maskrcnn_resnet50_fpn_coco":
        "https://download.pytorch.org/models/maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
    "maskrcnn_resnet50_fpn_v2_coco":
        "https://download.pytorch.org/models/maskrcnn_resnet50_fpn_v2_coco-73cbd019.pth",
}  # fmt: skip


def find_weights(name: str, folder: Path | None = None) -> Path:
    """Path of a weights file: ``name`` itself, or the download of ``torchvision:NAME``.

    Downloads are kept in ``folder``, by default ``cache_folder()``. Whether a path exists is
    checked when it is read.

    Raises:
        InputError: unknown ``torchvision:`` name, no connection, or another SHA-256.
    """
    if not name.startswith(PREFIX):
        return Path(name)
    url = PUBLISHED.get(name.removeprefix(PREFIX))
    if url is None:
        known = ", ".join(PREFIX + n for n in PUBLISHED)
        raise InputError(f"--weights {name}: not known; there are: {known}; or give a file")
    return fetch(url, folder or cache_folder())


def cache_folder() -> Path:
    """Folder of downloaded weights: $XDG_CACHE_HOME/bmask-slam, or ~/.cache/bmask-slam.

    Raises:
        InputError: neither is known, as in a container whose user has no name.
    """
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base) / "bmask-slam"
    try:
        return Path.home() / ".cache" / "bmask-slam"
    except RuntimeError as error:
        raise InputError(
            "no folder for downloaded weights is known, since this user has no home; set "
            "XDG_CACHE_HOME to one"
        ) from error


def fetch(url: str, folder: Path) -> Path:
    """Download a URL to ``folder`` unless the complete file is already there; its path.

    The file name ends in the first digits of its SHA-256 (name-0123abcd.pth); a file with another
    SHA-256 is not kept.

    Raises:
        InputError: no connection, or another SHA-256.
    """
    path = folder / url.rsplit("/", 1)[-1]
    download(WebFile(url, expected_sha256(path.name)), path)
    return path


def expected_sha256(name: str) -> str:
    """The first hexadecimal digits of the SHA-256 at the end of a file name.

    Raises:
        ValueError: a name without them.
    """
    match = re.search(r"-([0-9a-f]{8,64})\.\w+$", name)
    if match is None:
        raise ValueError(f"{name}: no SHA-256 at the end of the name")
    return match[1]
