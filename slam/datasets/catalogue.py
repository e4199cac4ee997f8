"""The catalogue of published recordings, data/sequences.yaml."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from bmask_slam.config.yaml import read_yaml
from bmask_slam.graph.data_files import data_path
from bmask_slam.graph.errors import InputError

CATALOGUE = "sequences.yaml"
SHOWN = 5
Layout = Literal["tum", "icl-nuim"]
SET_KEYS = {"title", "page", "licence", "archive", "layout", "camera", "sequences"}
RECORDING_KEYS = {"archive", "size", "sha256"}


@dataclass(frozen=True)
class Recording:
    """One published recording.

    Attributes:
        name: such as ``tum/freiburg1_xyz``; also its folder.
        url: of its archive.
        size, sha256: of the archive; None and "" if unknown.
        layout: layout of the files in the archive.
        camera: content of camera.yaml where the archive has none; empty: none is written.
        title, page, licence: of the data set.
    """

    name: str
    url: str
    size: int | None = None
    sha256: str = ""
    layout: Layout = "tum"
    camera: dict[str, Any] = field(default_factory=dict)
    title: str = ""
    page: str = ""
    licence: str = ""


def read_catalogue(file: Path | None = None) -> dict[str, Recording]:
    """Recordings by name, from the shipped catalogue or another one in its format.

    Raises:
        InputError: it is missing or in another format.
    """
    file = file or data_path(CATALOGUE)
    sets = read_yaml(file)
    if not isinstance(sets, dict):
        raise InputError(f"{file}: not a catalogue; expected sets of recordings by name")
    found = [
        _recording(file, name, sets[name], key) for name in sets for key in _keys(file, sets, name)
    ]
    return {recording.name: recording for recording in found}


def find(catalogue: dict[str, Recording], name: str) -> Recording:
    """The recording of a name.

    Raises:
        InputError: there is none; the message suggests similar names.
    """
    if name in catalogue:
        return catalogue[name]
    near = difflib.get_close_matches(name, catalogue, SHOWN, 0.5)
    hint = f"did you mean {', '.join(near)}? " if near else ""
    raise InputError(f"{name}: not in the catalogue; {hint}bmask-slam download --list names all")


def format_catalogue(catalogue: dict[str, Recording]) -> str:
    """A line for each recording with its size and whether its SHA-256 is known."""
    rows = []
    for recording in catalogue.values():
        size = f"{recording.size / 1e9:7.2f} GB" if recording.size else f"{'?':>10}"
        rows.append(f"{recording.name:<52}{size}  {'SHA-256' if recording.sha256 else ''}".rstrip())
    return "\n".join(rows)


def _keys(file: Path, sets: dict[str, Any], name: str) -> list[str]:
    given = sets[name]
    if not isinstance(given, dict) or not isinstance(given.get("sequences"), dict):
        raise InputError(f"{file}: {name}: expected a set with an archive and sequences")
    if unknown := set(given) - SET_KEYS:
        raise InputError(f"{file}: {name}: unknown key {sorted(unknown)[0]!r}")
    if given.get("layout", "tum") not in get_args(Layout):
        raise InputError(f"{file}: {name}.layout: {given['layout']!r}; use {get_args(Layout)}")
    return list(given["sequences"])


def _recording(file: Path, name: str, given: dict[str, Any], key: str) -> Recording:
    own = given["sequences"][key] or {}
    if unknown := set(own) - RECORDING_KEYS:
        raise InputError(f"{file}: {name}.{key}: unknown key {sorted(unknown)[0]!r}")
    url = str(own.get("archive", given.get("archive", "")))
    url = url.format(name=key, first=key.partition("_")[0])
    if not url.startswith(("https://", "http://")):
        raise InputError(f"{file}: {name}.{key}.archive: {url!r} is no web address")
    return Recording(
        f"{name}/{key}", url, own.get("size"), str(own.get("sha256", "")),
        given.get("layout", "tum"), dict(given.get("camera", {})),
        *(str(given.get(text, "")) for text in ("title", "page", "licence")),
    )  # fmt: skip
