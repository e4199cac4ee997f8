"""Recordings whose depth images have other stamps than when they were taken."""

from __future__ import annotations

from pathlib import Path


def with_depth_stamps(sequence: Path, folder: Path, shift_s: float) -> Path:
    """A sequence whose images are linked, in a folder, with ``shift_s`` added to depth's stamps."""
    folder.mkdir(exist_ok=True)
    for path in sequence.iterdir():
        if path.name != "depth.txt":
            (folder / path.name).symlink_to(path)
    lines = []
    for line in (sequence / "depth.txt").read_text(encoding="utf-8").splitlines():
        if not line.startswith("#"):
            stamp, name = line.split(maxsplit=1)
            lines.append(f"{float(stamp) + shift_s:.6f} {name}\n")
    (folder / "depth.txt").write_text("".join(lines), encoding="utf-8")
    return folder
