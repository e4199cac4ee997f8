"""A published recording in a folder of its own: downloaded, checked, unpacked, complete."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from bmask_slam.config.yaml import format_yaml
from bmask_slam.datasets.catalogue import Recording
from bmask_slam.datasets.icl_nuim import to_tum_layout
from bmask_slam.datasets.unpack import unpack
from bmask_slam.datasets.web_file import WebFile, download
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.whole_file import whole_file

SUMS = "SHA256SUMS"
LISTS = ("rgb.txt", "associations.txt")
Progress = Callable[[str, int, int], None]
"""Called with what is done, and the bytes that are done and all of them (0: unknown)."""


def obtain(
    recording: Recording,
    folder: Path,
    progress: Progress | None = None,
    keep_archive: bool = False,
) -> Path:
    """The recording's folder, ``folder/SET/SEQUENCE``; nothing is done where it is there already.

    The folder appears when it is complete. The archive's SHA-256 is noted in ``folder/SHA256SUMS``
    (``sha256sum`` reads it), and a later download of a recording that the catalogue has no SHA-256
    of must agree with it.

    Raises:
        InputError: no connection, a file that is not the one expected, a broken or dangerous
            archive, or one without image lists.
    """
    tell = progress or (lambda what, done, total: None)
    place = folder / recording.name
    if place.is_dir():
        return place
    place.parent.mkdir(parents=True, exist_ok=True)
    archive = place.parent / recording.url.rsplit("/", 1)[-1]
    known = read_sums(folder / SUMS)
    expected = recording.sha256 or known.get(recording.url.rsplit("/", 1)[-1], "")
    found = download(
        WebFile(recording.url, expected, recording.size),
        archive,
        lambda done, total: tell("download", done, total),
    )
    write_sums(folder / SUMS, known | {archive.name: found})
    unpacked = place.with_name(f".{place.name}.unpacking")
    shutil.rmtree(unpacked, ignore_errors=True)
    try:
        unpack(archive, unpacked, lambda done, total: tell("unpack", done, total))
        os.replace(_completed(unpacked, recording), place)
    finally:
        shutil.rmtree(unpacked, ignore_errors=True)
    if not keep_archive:
        archive.unlink()
    return place


def read_sums(path: Path) -> dict[str, str]:
    """SHA-256 by file name, of lines as ``sha256sum`` writes them; empty without the file."""
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    pairs = (line.split(maxsplit=1) for line in lines if line.strip())
    return {name.strip(): digest for digest, name in pairs}


def write_sums(path: Path, sums: dict[str, str]) -> None:
    """Write such lines, sorted by name."""
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _completed(unpacked: Path, recording: Recording) -> Path:
    """The folder with the image lists within what was unpacked, with all that a run needs."""
    inner = [path for path in unpacked.iterdir() if path.is_dir()]
    candidates = [unpacked, *sorted(inner)]
    root = next((p for p in candidates if any((p / name).is_file() for name in LISTS)), None)
    if root is None:
        raise InputError(f"{recording.url}: the archive holds no {' or '.join(LISTS)}")
    if recording.layout == "icl-nuim":
        to_tum_layout(root)
    if recording.camera and not (root / "camera.yaml").exists():
        text = format_yaml(recording.camera)
        (root / "camera.yaml").write_text(text, encoding="utf-8")
    return root
