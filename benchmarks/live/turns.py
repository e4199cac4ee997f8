"""The live loop at the camera's own speed, on recordings, and on what is made of them.

    python -m benchmarks.live.turns [SEQUENCE ...] [--repeats 3] [--core N] [--before FOLDER]

Each recording also mirrored, backward and turned (`benchmarks.cameras.mirrored`): what happens in a
fast turn depends on which landmarks happen to be found, and on how soon the map's process answers.
Of every repeat the frames that were lost and dropped, and the error (ATE RMSE, mm). ``--core``: all
processes on one core. ``--before``: beside other code, as for `benchmarks.live.speed`.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.cameras.mirrored import CHANGES, write_changed
from benchmarks.live.speed import measured, repeats_of
from benchmarks.paths import SHARED
from bmask_slam.run_folder.reader import Run

NAME = 34


def repeat(sequence: Path, out: Path, code: Path | None) -> tuple[int, int, float]:
    """Frames lost and dropped, and the ATE in millimetres, of one run by this code or other."""
    found = measured(["live", str(sequence), "--realtime"], out, code)
    lost = Run(out).frames.status.count("LOST")
    return lost, int(found["frames_dropped"]), 1e3 * found["ate_rmse"]


def inputs_of(source: Path, scratch: Path) -> dict[str, Path]:
    """A recording and what is made of it, by name; the name tells the kind of camera."""
    inputs = {source.name: source}
    for name, change in CHANGES.items():
        made = scratch / f"{source.name}_{name}"
        write_changed(source, made, change)
        inputs[made.name] = made
    return inputs


def line(title: str, repeats: list[tuple[int, int, float]]) -> str:
    """A line of the table."""
    lost, dropped, errors = (
        " ".join(f"{value:.{digits}f}" for value in column)
        for column, digits in zip(zip(*repeats, strict=True), (0, 0, 1), strict=True)
    )
    return f"{title:{NAME}}{lost:>14}{dropped:>14}{errors:>20}"


def main() -> None:
    """Print a line for each recording."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sequences", type=Path, nargs="*", default=[SHARED / "tum_fr1_rpy"])
    given, codes = repeats_of(parser)
    print(f"{'':{NAME}}{'lost':>14}{'dropped':>14}{'ATE mm':>20}")
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        sequences = {
            k: s for source in given.sequences for k, s in inputs_of(source, scratch).items()
        }
        for name, sequence in sequences.items():
            runs: dict[str, list[tuple[int, int, float]]] = {when: [] for when in codes}
            for _ in range(given.repeats):
                for when, code in codes.items():
                    runs[when].append(repeat(sequence, scratch / "run", code))
            for when, repeats in runs.items():
                print(line(f"{name}{when}", repeats), flush=True)


if __name__ == "__main__":
    main()
