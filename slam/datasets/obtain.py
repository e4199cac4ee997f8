"""Download of a published recording: checked, unpacked, converted to TUM's layout."""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.datasets.catalogue import Recording
from bmask_slam.datasets.unpack import unpack
from bmask_slam.datasets.web_file import WebFile, download, locked
from bmask_slam.evaluation.reference import BONN, TRUTH_BODY
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import target_below
from bmask_slam.graph.files.reading import read_lines
from bmask_slam.graph.files.whole_file import remove, whole_file
from bmask_slam.graph.files.yaml_file import format_yaml
from bmask_slam.graph.trajectory import write_tum
from bmask_slam.sequences.formats.numbered import FPS_HZ
from bmask_slam.sequences.formats.numbered_folders import icl_truth
from bmask_slam.sequences.lists import read_associations

logger = logging.getLogger(__name__)

SUMS = "SHA256SUMS"
RECEIVED = "received.txt"
LISTS = ("rgb.txt", "associations.txt")
Progress = Callable[[str, int, int], None]
"""Called with the name of the step, the bytes done and all bytes (0: unknown)."""


@dataclass(frozen=True)
class _Archive:
    """A downloaded archive and its SHA-256."""

    path: Path
    sha256: str


def obtain(
    recording: Recording,
    folder: Path,
    progress: Progress | None = None,
    keep_archive: bool = False,
) -> Path:
    """The recording's folder, ``folder/SET/SEQUENCE``; downloads it unless it is there already.

    The folder appears when it is complete; of processes that ask for it at once, one downloads and
    unpacks. The archive's SHA-256 is stored in ``folder/SHA256SUMS`` (in the format of
    ``sha256sum``); if the catalogue has none, a later download must agree with it. Where the
    archive came from, its size and SHA-256 are in RECEIVED in the recording's folder.

    Raises:
        InputError: no connection, a file that is not the one expected, a broken or dangerous
            archive, or one without image lists.
    """
    report = progress or (lambda what, done, total: None)
    place = target_below(folder, recording.name)
    if place.is_dir():
        return place
    with locked(folder):
        if not place.is_dir():  # another process has obtained it meanwhile
            archive = _received(recording, folder, report)
            _unpack_to(place, archive, recording, report)
            if not keep_archive:
                archive.path.unlink()
    return place


def _unpack_to(place: Path, archive: _Archive, recording: Recording, report: Progress) -> None:
    """Unpack and complete a recording; its folder appears when that is done."""
    unpacking = f".{place.name}.unpacking-"
    for killed in place.parent.glob(f"{unpacking}*"):
        remove(killed)
    private = Path(tempfile.mkdtemp(prefix=unpacking, dir=place.parent))
    unpacked = private / place.name
    try:
        unpack(archive.path, unpacked, lambda done, total: report("unpack", done, total))
        root = _completed(unpacked, recording)
        _write_received(root / RECEIVED, recording, archive)
        os.replace(root, place)
    finally:
        shutil.rmtree(private, ignore_errors=True)


def _received(recording: Recording, folder: Path, report: Progress) -> _Archive:
    """The archive, downloaded and checked as far as its SHA-256 is known."""
    archive = target_below(folder, recording.archive)
    known = read_sums(folder / SUMS)
    expected = recording.sha256 or known.get(archive.name, "")
    found = download(
        WebFile(recording.url, expected, recording.size),
        archive,
        lambda done, total: report("download", done, total),
    )
    if not expected:
        logger.warning(
            "%s: no SHA-256 is known to check it by; received %d bytes with %s, kept in %s",
            *(recording.name, archive.stat().st_size, found, folder / SUMS),
        )
    write_sums(folder / SUMS, known | {archive.name: found})
    return _Archive(archive, found)


def read_sums(path: Path) -> dict[str, str]:
    """SHA-256 by file name, from a file in the format of ``sha256sum``; empty if missing."""
    cure = "remove it; the sums of further downloads are written to a new one"
    lines = read_lines(path, cure) if path.is_file() else ()
    pairs = [line.split(maxsplit=1) for _, line in lines]
    if any(len(pair) < 2 for pair in pairs):
        raise InputError(f"{path}: a line that is not 'SHA-256  NAME'; {cure}")
    return {name: digest for digest, name in pairs}


def write_sums(path: Path, sums: dict[str, str]) -> None:
    """Write SHA-256 by file name in the format of ``sha256sum``, sorted by name."""
    text = "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items()))
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _write_received(path: Path, recording: Recording, archive: _Archive) -> None:
    """Write what was received, beside the data: it stays with them where they are moved to."""
    check = "that of the catalogue" if recording.sha256 else "not known to the catalogue"
    lines = [
        f"url     {recording.url}",
        f"bytes   {archive.path.stat().st_size}",
        f"sha256  {archive.sha256} ({check})",
    ]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _completed(unpacked: Path, recording: Recording) -> Path:
    """The unpacked folder with the image lists, with the files added that a run needs."""
    inner = [path for path in unpacked.iterdir() if path.is_dir()]
    candidates = [unpacked, *sorted(inner)]
    root = next((p for p in candidates if any((p / name).is_file() for name in LISTS)), None)
    if root is None:
        raise InputError(f"{recording.url}: the archive holds no {' or '.join(LISTS)}")
    if recording.layout == "icl-nuim":
        _icl_to_tum_layout(root)
    if recording.layout == "bonn":
        (root / TRUTH_BODY).write_text(BONN.yaml(), encoding="utf-8")
    if recording.camera and not (root / "camera.yaml").exists():
        text = format_yaml(recording.camera)
        (root / "camera.yaml").write_text(text, encoding="utf-8")
    return root


def _icl_to_tum_layout(folder: Path) -> None:
    """Write rgb.txt, depth.txt and groundtruth.txt in a folder of ICL-NUIM's files.

    Its lists hold frame numbers.

    Raises:
        InputError: the lists or the poses are missing or broken.
    """
    truth = icl_truth(folder)
    images = read_associations(folder / "associations.txt")
    for name, listed in zip(("rgb.txt", "depth.txt"), images, strict=True):
        lines = [
            f"{number / FPS_HZ:.6f} {path.relative_to(folder).as_posix()}"
            for number, path in zip(listed.timestamps_s, listed.files, strict=True)
        ]
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    write_tum(folder / "groundtruth.txt", truth)
