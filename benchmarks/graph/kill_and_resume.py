"""Kills a run with checkpoints at random moments, resumes it, and compares all its files.

    python -m benchmarks.graph.kill_and_resume SEQUENCE --every 60 --kills 10

Each row is a run of its own: the program is started as a user would, killed (SIGKILL) at a moment
drawn from the time between its first checkpoint (before the first frame) and the end of the
undisturbed run, and resumed. The cost of the checkpoints in the undisturbed run is printed too.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import re
import shutil
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path

COMPARED = ("trajectory.txt", "keyframes.txt", "landmarks.ply", "graph", "map")
CHECKPOINT = re.compile(r"checkpoint after (\d+) frames: ([\d.]+) MB, (\d+) ms")


@dataclass(frozen=True)
class Kill:
    """One run that was killed.

    Attributes:
        after_s: seconds after the first checkpoint.
        frames: lines of frames.csv at the kill.
        checkpoint: frames of the last checkpoint.
        was: the last line of the log at the kill.
        same: whether all files equal those of the undisturbed run.
    """

    after_s: float
    frames: int
    checkpoint: int
    was: str
    same: bool


def program(*arguments: object) -> subprocess.Popen[bytes]:
    """``bmask-slam run`` with these arguments, quietly."""
    given = [*map(str, arguments), "--segmenter", "none", "--quiet"]
    command = [sys.executable, "-m", "bmask_slam", "run", *given]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def finish(*arguments: object) -> float:
    """Run to the end; the seconds that it took."""
    start_s = time.perf_counter()
    if program(*arguments).wait() != 0:
        raise SystemExit(f"failed: bmask-slam run {' '.join(map(str, arguments))}")
    return time.perf_counter() - start_s


def kill_once(
    options: list[object], out: Path, expected: dict[str, object], after_s: float
) -> Kill:
    """A run that is killed after so many seconds and then resumed."""
    shutil.rmtree(out, ignore_errors=True)
    process = program(*options, "--out", out)
    while not (out / "checkpoint").exists() and process.poll() is None:
        time.sleep(0.01)
    try:
        process.wait(after_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    log, frames = (out / "log.txt").read_text(), len(frame_rows(out))
    reached = max([0, *(int(found[1]) for found in CHECKPOINT.finditer(log))])
    finish("--resume", out)
    last = log.splitlines()[-1].split(": ", 1)[-1]
    return Kill(round(after_s, 2), frames, reached, last[:48], left_by(out) == expected)


def frame_rows(out: Path) -> list[dict[str, str]]:
    """The lines of frames.csv, without times."""
    with (out / "frames.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if not k.endswith("_ms")} for row in rows]


def left_by(out: Path) -> dict[str, object]:
    """What a run leaves, but for times."""
    files: dict[str, object] = {name: (out / name).read_bytes() for name in COMPARED}
    return {**files, "frames.csv": frame_rows(out), "names": sorted(p.name for p in out.iterdir())}


def logged_s(out: Path) -> float:
    """Seconds from the first to the last line of a run's log."""
    lines = (out / "log.txt").read_text().splitlines()
    first, last = (datetime.fromisoformat(line[:23]) for line in (lines[0], lines[-1]))
    return (last - first).total_seconds()


def main() -> None:
    """Print a table, or a JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--every", type=int, default=60, help="frames between checkpoints")
    parser.add_argument("--max-frames", type=int, default=10**9)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/bench/kills"))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    whole, out, rng = given.work / "undisturbed", given.work / "killed", random.Random(given.seed)
    shutil.rmtree(given.work, ignore_errors=True)
    options = [given.sequence, "--max-frames", given.max_frames]
    plain_s = finish(*options, "--out", given.work / "plain")
    options += ["--checkpoint-every", given.every]
    whole_s = finish(*options, "--out", whole)
    expected, tracked_s = left_by(whole), logged_s(whole)
    costs = [found.groups() for found in CHECKPOINT.finditer((whole / "log.txt").read_text())]
    moments = [rng.uniform(0, tracked_s) for _ in range(given.kills)]
    kills = [kill_once(options, out, expected, after_s) for after_s in moments]
    if given.json:
        rows = [asdict(kill) for kill in kills]
        print(json.dumps({"seconds": [plain_s, whole_s], "checkpoints": costs, "kills": rows}))
        return
    print(f"whole run {plain_s:.1f} s without checkpoints, {whole_s:.1f} s with")
    for frames, megabytes, ms in costs:
        print(f"checkpoint after {frames:>5} frames: {megabytes:>6} MB {ms:>5} ms")
    print("killed after  frames  checkpoint  same bytes  at")
    for kill in kills:
        same = "yes" if kill.same else "NO"
        columns = f"{kill.after_s:>10} s  {kill.frames:>6}  {kill.checkpoint:>10}  {same:>10}"
        print(f"{columns}  {kill.was}")


if __name__ == "__main__":
    main()
