"""Where the project's own data files lie."""

from __future__ import annotations

from pathlib import Path

from graph.errors import InputError


def data_path(*parts: str) -> Path:
    """A file or folder of the project's ``data/``, in a checkout and in an installed wheel.

    Raises:
        InputError: there is no such file; the message lists what is there.
    """
    top = Path(__file__).resolve().parents[1]
    root = next((p for p in (top / "slam" / "data", top / "data") if p.is_dir()), None)
    if root is None:
        raise InputError(f"{top}: the project's data folder is missing; install it again")
    path = root.joinpath(*parts)
    if not path.exists():
        there = sorted(p.stem for p in path.parent.glob(f"*{path.suffix}"))
        raise InputError(f"{path}: no such file; there are: {', '.join(there) or 'none'}")
    return path
