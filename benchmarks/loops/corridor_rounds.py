"""What closed loops bring where one place is passed again and again.

    python -m benchmarks.loops.corridor_rounds --out runs/bench/rounds [--rounds 8] [--fps 10]

The rendered corridor is walked so many times; without loops the drift goes on to grow with every
round, with them it ends with the first. After one round closed loops take away a part only: a
random walk that is held at its end falls to half, whatever the system (see loop_limits.py), and
what is no drift stays.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.system_config import SystemConfig

TITLES = ("rounds", "frames", "path m", "ATE without", "ATE closed", "ratio", "RPE/s", "RPE/s")


def figures(sequence: Path, out: Path, frames: int, closed: bool) -> dict[str, float]:
    """What a run is judged by, by name."""
    settings = (f"loops.enabled={str(closed).lower()}", "semantics.segmenter.name=none")
    config = resolve(SystemConfig, None, settings)
    name = f"{'closed' if closed else 'open'}-{frames}"
    options = RunOptions(
        sequence, config, max_frames=frames, out=out / name, overwrite=True, quiet=True
    )
    return {row["name"]: float(row["value"]) for row in run(options).rows}


def main() -> None:
    """Print the table; lengths of error in mm."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("runs/bench/rounds"))
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--fps", type=float, default=10.0)
    arguments = parser.parse_args()
    sequence = arguments.out / f"corridor-{arguments.rounds}"
    if not sequence.is_dir():
        render_sequence(
            RenderConfig("corridor", rounds=arguments.rounds, fps=arguments.fps), sequence
        )
    positions = read_tum(sequence / "groundtruth.txt").positions_world
    walked_m = np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))
    total = len(positions)
    print("".join(f"{title:>13}" for title in TITLES))
    for rounds in sorted({1, 2, arguments.rounds}):
        frames = round(total * rounds / arguments.rounds)
        without = figures(sequence, arguments.out, frames, closed=False)
        closed = figures(sequence, arguments.out, frames, closed=True)
        cells = (
            f"{rounds}",
            f"{frames}",
            f"{walked_m[frames - 2]:.1f}",
            f"{1e3 * without['ate_rmse']:.2f}",
            f"{1e3 * closed['ate_rmse']:.2f}",
            f"{closed['ate_rmse'] / without['ate_rmse']:.3f}",
            f"{1e3 * without['rpe_trans_rmse_second']:.2f}",
            f"{1e3 * closed['rpe_trans_rmse_second']:.2f}",
        )
        print("".join(f"{cell:>13}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
