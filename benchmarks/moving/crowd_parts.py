"""Tracking among people: parts of Bonn's crowd, every frame of them or fewer, by default options.

    python -m benchmarks.moving.crowd_parts [--first N ...] [--stride N ...] [--repeats N]

Where a recording begins, and how far its frames are apart, decides how much of the first images
people fill and how far they walk between two frames. Each part is run with several grids of
keypoints (see benchmarks/moving/no_harm.py): a camera that follows a person is off by decimetres in
some of them.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

from benchmarks.moving.no_harm import other_keypoints
from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.suite.never_lost import Input, outcome

CROWD = SHARED / "bonn_crowd"
FIRST = (0, 60, 110, 150, 170, 190)
STRIDES = (2, 3)


def part_from(first: int, into: Path) -> Path:
    """A folder of the recording from its colour image number ``first`` on; images are links."""
    into.mkdir()
    for name in ("camera.yaml", "groundtruth.txt"):
        copyfile(CROWD / name, into / name)
    begin_s = 0.0
    for kind in ("rgb", "depth"):
        (into / kind).symlink_to(CROWD / kind)
        lines = (CROWD / f"{kind}.txt").read_text(encoding="utf-8").splitlines()
        rows = [line for line in lines if line and not line.startswith("#")]
        if kind == "rgb":
            begin_s = float(rows[first].split()[0])
        kept = [row for row in rows if float(row.split()[0]) > begin_s - 0.02]
        (into / f"{kind}.txt").write_text("\n".join(kept) + "\n", encoding="utf-8")
    return into


def ates_mm(sequence: Path, stride: int, repeats: int) -> list[float]:
    """The errors of runs by default options, each with another grid of keypoints."""
    entry = Input(CROWD.name, stride=stride)
    return [outcome(entry, sequence, [other_keypoints(k)]).ate_mm for k in range(repeats)]


def _row(name: str, errors_mm: Sequence[float]) -> tuple[str, str]:
    return name, ", ".join(f"{error:.1f}" for error in errors_mm)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--first", type=int, nargs="*", default=FIRST, metavar="N")
    parser.add_argument("--stride", type=int, nargs="*", default=STRIDES, metavar="N")
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    rows = []
    with TemporaryDirectory() as folder:
        for first in given.first:
            part = part_from(first, Path(folder) / f"bonn_crowd_{first}")
            rows.append(_row(f"from frame {first}", ates_mm(part, 1, given.repeats)))
    for stride in given.stride:
        rows.append(_row(f"every frame number {stride}", ates_mm(CROWD, stride, given.repeats)))
    print(table(("Bonn crowd", "ATE mm"), rows))


if __name__ == "__main__":
    main()
