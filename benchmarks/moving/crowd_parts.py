"""Tracking among people: parts of Bonn's crowd, every frame of them or fewer.

    python -m benchmarks.moving.crowd_parts [--how NAME ...] [--first N ...] [--stride N ...]
                                            [--segmenter NAME] [--repeats N] [--core N]
                                            [--before FOLDER]

Where a recording begins, and how far its frames are apart, decides how much of the first images
people fill and how far they walk between two frames. Each part is run with several grids of
keypoints (see benchmarks/moving/no_harm.py): a camera that follows a person is off by decimetres in
some of them. ``--how``: by `run`, `run --parallel`, `live`, or `live --realtime`. ``--core``: all
processes on one core. ``--before``: beside other code, as for `benchmarks.live.speed`.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from shutil import copyfile
from tempfile import TemporaryDirectory

from benchmarks.live.speed import measured, repeats_of
from benchmarks.moving.no_harm import other_keypoints
from benchmarks.pages import table
from benchmarks.paths import SHARED

CROWD = SHARED / "bonn_crowd"
FIRST = (0, 60, 110, 150, 170, 190)
STRIDES = (2, 3)
WAYS = {
    "run": ["run"],
    "parallel": ["run", "--parallel"],
    "live": ["live"],
    "realtime": ["live", "--realtime"],
}


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


def parts(given: argparse.Namespace, folder: Path) -> Iterator[tuple[str, Path, list[str]]]:
    """Name, folder and options of each part; ``run`` alone leaves frames out."""
    for first in given.first:
        yield f"from frame {first}", part_from(first, folder / f"bonn_crowd_{first}"), []
    for stride in given.stride:
        if set(given.how) <= {"run", "parallel"}:
            yield f"every frame number {stride}", CROWD, ["--stride", str(stride)]


def ates_mm(command: Sequence[str], repeats: int, code: Path | None) -> Iterator[float]:
    """The errors of a command's runs, each with another grid of keypoints."""
    with TemporaryDirectory() as folder:
        for k in range(repeats):
            options = [*command, "--set", other_keypoints(k)]
            yield 1e3 * measured(options, Path(folder) / "run", code)["ate_rmse"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--how", nargs="*", choices=list(WAYS), default=["run"])
    parser.add_argument("--first", type=int, nargs="*", default=FIRST, metavar="N")
    parser.add_argument("--stride", type=int, nargs="*", default=STRIDES, metavar="N")
    parser.add_argument("--segmenter", metavar="NAME")
    given, codes = repeats_of(parser)
    masks = ["--segmenter", given.segmenter] if given.segmenter else []
    columns = [
        (f"{way}{when}", WAYS[way], code) for way in given.how for when, code in codes.items()
    ]
    rows = []
    with TemporaryDirectory() as folder:
        for name, part, options in parts(given, Path(folder)):
            errors = (
                ates_mm([way[0], str(part), *way[1:], *masks, *options], given.repeats, code)
                for _, way, code in columns
            )
            rows.append((name, *(", ".join(f"{mm:.1f}" for mm in found) for found in errors)))
    print(table(("Bonn crowd, ATE mm", *(title for title, *_ in columns)), rows))


if __name__ == "__main__":
    main()
