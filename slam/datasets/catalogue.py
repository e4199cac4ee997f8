"""The catalogue of published recordings, data/sequences.yaml."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, PositiveInt, StringConstraints

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.file_names import check_name
from bmask_slam.graph.files.json_file import check_json
from bmask_slam.graph.files.yaml_file import read_yaml

CATALOGUE = "sequences.yaml"
SHOWN = 5
Layout = Literal["tum", "icl-nuim", "bonn"]
STRICT = ConfigDict(strict=True, extra="forbid", frozen=True)


class _Entry(BaseModel):
    """What a catalogue says of one recording."""

    model_config = STRICT
    archive: str = ""
    size: PositiveInt | None = None
    sha256: Annotated[str, StringConstraints(pattern=r"^([0-9a-fA-F]{64})?$")] = ""


class _Set(BaseModel):
    """What it says of a set of them."""

    model_config = STRICT
    sequences: dict[str, _Entry | None]
    archive: str = ""
    layout: Layout = "tum"
    camera: dict[str, Any] = {}
    title: str = ""
    page: str = ""
    licence: str = ""


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

    @property
    def archive(self) -> str:
        """Where its archive is kept, below the same folder as itself."""
        return f"{self.name.rpartition('/')[0]}/{self.url.rsplit('/', 1)[-1]}"


def read_catalogue(file: Path | None = None) -> dict[str, Recording]:
    """Recordings by name, from the shipped catalogue or another one in its format.

    Raises:
        InputError: it is missing or in another format.
    """
    file = file or data_path(CATALOGUE)
    sets = read_yaml(file)
    cure = "expected sets of recordings by name"
    found = check_json(sets, dict[str, _Set], f"{file}: not a catalogue", cure)
    recordings = [_recording(file, n, s, k) for n, s in found.items() for k in s.sequences]
    return {recording.name: recording for recording in recordings}


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


def _recording(file: Path, name: str, given: _Set, key: str) -> Recording:
    where, own = f"{file}: {name}.{key}", given.sequences[key] or _Entry()
    url = own.archive or given.archive
    url = url.replace("{name}", key).replace("{first}", key.partition("_")[0])
    if not url.startswith(("https://", "http://")) or not url.isprintable() or url.endswith("/"):
        raise InputError(f"{where}.archive: {url[:100]!r} is no web address of a file")
    check_name(f"{name}/{key}", where)
    about = given.layout, given.camera, given.title, given.page, given.licence
    return Recording(f"{name}/{key}", url, own.size, own.sha256.lower(), *about)
