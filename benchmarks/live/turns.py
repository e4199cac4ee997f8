"""The live loop at the camera's own speed, on recordings, and on what is made of them.

    python -m benchmarks.live.turns [SEQUENCE ...] [--repeats 3] [--core N] [--before FOLDER]

Each recording also mirrored, backward and turned (`benchmarks.cameras.mirrored`): what happens in a
fast turn depends on which landmarks happen to be found, and on how soon the map's process answers.
Of every repeat the frames that were lost and dropped, and the error (ATE RMSE, mm). ``--core``: all
processes on one core. ``--before``: beside other code, as for `benchmarks.live.speed`.
"""

from __future__ import annotations

import argparse
import csv
import os
import tempfile
from pathlib import Path

from benchmarks.cameras.mirrored import CHANGES, write_changed
from benchmarks.live.speed import measured
from benchmarks.paths import SHARED

NAME = 34


def repeat(sequence: Path, out: Path, code: Path | None) -> tuple[int, int, float]:
    """Frames lost and dropped, and the ATE in millimetres, of one run by this code or other."""
    found = measured(["live", str(sequence), "--realtime"], out, code)
    with (out / "frames.csv").open(encoding="utf-8", newline="") as file:
        lost = sum(row["status"] == "LOST" for row in csv.DictReader(file))
    return lost, int(found["frames_dropped"]), 1e3 * found["ate_rmse"]


def main() -> None:
    """Print a line for each recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="*", default=[SHARED / "tum_fr1_rpy"])
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--core", type=int)
    parser.add_argument("--before", type=Path, metavar="FOLDER")
    given = parser.parse_args()
    if given.core is not None:
        os.sched_setaffinity(0, {given.core})
    codes = {"": None} if given.before is None else {", before": given.before, "": None}
    print(f"{'':{NAME}}{'lost':>14}{'dropped':>14}{'ATE mm':>20}")
    with tempfile.TemporaryDirectory() as scratch:
        for source in given.sequences:
            inputs = {source.name: source}
            for name, change in CHANGES.items():
                made = Path(scratch) / f"{source.name}_{name}"  # a name tells the kind of camera
                write_changed(source, made, change)
                inputs[made.name] = made
            for name, sequence in inputs.items():
                runs: dict[str, list[tuple[int, int, float]]] = {when: [] for when in codes}
                for _ in range(given.repeats):
                    for when, code in codes.items():
                        runs[when].append(repeat(sequence, Path(scratch) / "run", code))
                for when, repeats in runs.items():
                    lost, dropped, errors = zip(*repeats, strict=True)
                    cells = [" ".join(map(str, column)) for column in (lost, dropped)]
                    cells.append(" ".join(f"{error:.1f}" for error in errors))
                    title = f"{name}{when}"
                    print(f"{title:{NAME}}{cells[0]:>14}{cells[1]:>14}{cells[2]:>20}", flush=True)


if __name__ == "__main__":
    main()
