"""Where the project's own data files lie."""

from __future__ import annotations

import re
from pathlib import Path

from bmask_slam.graph.errors import InputError, did_you_mean


def data_path(*parts: str) -> Path:
    """A file or folder of the project's ``data/``, in a checkout and in an installed wheel.

    Raises:
        InputError: there is no such file; the message lists what is there.
    """
    root = Path(__file__).resolve().parents[2] / "data"
    if not root.is_dir():
        raise InputError(f"{root}: the project's data folder is missing; install it again")
    path = root.joinpath(*parts)
    if not path.exists():
        available = sorted(p.stem for p in path.parent.glob(f"*{path.suffix}"))
        listed = ", ".join(available) or "none"
        near = did_you_mean(path.stem, available)
        raise InputError(f"{path}: no such file; there are: {listed}{near}")
    return path


def given_or_shipped(name: str | Path, kind: str) -> Path:
    """A YAML file from its path, or from the bare name of one in ``data/``'s folder ``kind``.

    Raises:
        InputError: a bare name that is neither.
    """
    if re.fullmatch(r"[\w-]+", str(name)) and not Path(name).is_file():
        return data_path(kind, f"{name}.yaml")
    return Path(name)
