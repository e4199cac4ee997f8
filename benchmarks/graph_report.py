"""Run the benchmarks of the graph one after the other and keep what they print in docs/graph.md.

    python benchmarks/graph_report.py [--only loops,session] [--sequences runs/bench]

What a benchmark prints stands in the report as it is, below the command. With ``--only`` the other
sections stay as they were.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.machine import describe_commit, now, processor  # noqa: E402

REPORT = ROOT / "docs" / "graph.md"
HEAD = """# What the graph reaches

Written by `python benchmarks/graph_report.py`; each section is what its command printed.
"""
SECTIONS = {
    "session": ("A long session with bounded cost", "long_session.py"),
    "loops": ("Loops closed, and wrong ones survived", "loop_closing.py {sequences}/corridor"),
    "pose-graphs": ("Pose graphs, clean and with wrong loops", "pose_graphs.py"),
    "kills": (
        "Killed and resumed",
        "kill_and_resume.py {sequences}/office-300 --every 30 --kills 10 --max-frames 150",
    ),
    "calibration": ("Self-calibration", "calibration.py --out {sequences}/calibration"),
    "covariances": (
        "How honest the covariances are",
        "covariances.py --runs 200 --sequence {sequences}/living_room",
    ),
}


def section(name: str, sequences: Path) -> str:
    """Run a benchmark; its section."""
    title, command = SECTIONS[name]
    command = f"benchmarks/{command.format(sequences=sequences)}"
    print(f"{title}: python {command}", flush=True)
    begin_s = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *command.split()], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{command} failed:\n{done.stderr[-2000:]}")
    wall_s = time.perf_counter() - begin_s
    commit = describe_commit(ROOT, ("docs/graph.md",))
    when = f"{processor()}; commit {commit}; {now()}; {wall_s:.0f} s."
    return f"## {title}\n\n`python {command}`\n\n```\n{done.stdout.strip()}\n```\n\n{when}\n"


def main() -> None:
    """Write the report, or renew some of its sections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", help=f"some of {','.join(SECTIONS)}")
    parser.add_argument("--sequences", type=Path, default=Path("runs/bench"))
    arguments = parser.parse_args()
    chosen = arguments.only.split(",") if arguments.only else list(SECTIONS)
    for name in chosen:
        new = section(name, arguments.sequences)
        old = REPORT.read_text() if REPORT.exists() else HEAD
        parts = {part.split("\n", 1)[0]: part for part in re.split(r"(?m)^(?=## )", old)[1:]}
        parts[new.split("\n", 1)[0]] = new.rstrip() + "\n\n"
        titles = [f"## {title}" for title, _ in SECTIONS.values()]
        body = "".join(parts[title] for title in titles if title in parts)
        REPORT.write_text(f"{HEAD}\n{body.rstrip()}\n")


if __name__ == "__main__":
    main()
