"""Two machines: a recording is tracked in one network namespace, map and masks are in another.

    python -m benchmarks.live.workstation SEQUENCE [--away 5 10] [-- --segmenter none]

The link between them (`slow_link`) has 20 ms there and back and loses 1 % of the packets each way.
With --away the link is dead from that second after the first frame on, for so many seconds. What
stands after -- goes to `bmask-slam live`. Both share this machine's processors. Needs root.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.live.slow_link import ROBOT, WORKSTATION, LinkOptions, SlowLink
from bmask_slam.live.network.connection import make_token

PROBE = f"""import socket, time
for _ in range(5):
    begin_s = time.monotonic()
    socket.create_connection(("{WORKSTATION}", 7717)).close()
    print(time.monotonic() - begin_s)"""
PYTHON = [sys.executable, "-m", "bmask_slam"]


def measure(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Run both, and return the figures."""
    token, out = folder / "token", options.out / f"workstation-{options.sequence.name}"
    make_token(token)
    given = ["--token-file", str(token)]
    with SlowLink(LinkOptions(options.delay_ms / 2e3, options.loss)) as link:
        there = link.words(WORKSTATION, [*PYTHON, "workstation", "--host", WORKSTATION, *given])
        live = [*PYTHON, "live", str(options.sequence), "--out", str(out), "--overwrite", "-v",
                "--quiet", "--max-frames", str(options.frames), "--realtime", "--calibrate", "off",
                "--workstation", WORKSTATION, *given, *options.live]  # fmt: skip
        server = subprocess.Popen(there)
        time.sleep(5)
        probe = subprocess.run(
            link.words(ROBOT, [sys.executable, "-c", PROBE]), stdout=subprocess.PIPE, check=True
        )
        connect_ms = [round(1e3 * float(word)) for word in probe.stdout.split()]
        begun_s = time.monotonic()
        robot = subprocess.Popen(link.words(ROBOT, live))
        samples = watch(robot, link, out, options.away)
        wall_s = time.monotonic() - begun_s
        server.terminate()
        server.wait(20)
        packets, lost = link.packets, link.lost
    health = json.loads((out / "health.json").read_text())
    rows = {row["name"]: row["value"] for row in json.loads((out / "metrics.json").read_text())}
    wanted = ("frames", "frames_dropped", "lost_frames", "keyframes", "latency_ms_median",
              "latency_ms_p95", "masks_dropped", "map_deaths", "workstation_losses")  # fmt: skip
    return {
        "connect_ms": connect_ms,
        "packets": packets,
        "packets_lost": lost,
        "wall_s": round(wall_s, 1),
        "ate_mm": round(1e3 * rows.get("ate_rmse", float("nan")), 1),
        **{name: health[name] for name in wanted},
        "megabytes_sent": round(health["workstation_sent_bytes"] / 1e6, 1),
        "megabytes_received": round(health["workstation_received_bytes"] / 1e6, 1),
        "every_second": samples,
    }


def watch(
    robot: subprocess.Popen[bytes], link: SlowLink, out: Path, away: list[float] | None
) -> list[Any]:
    """What health.json says each second; lets the link be dead for a while."""
    found: list[Any] = []
    first_s = None
    before = (out / "health.json").stat().st_mtime if (out / "health.json").exists() else 0.0
    while robot.poll() is None:
        time.sleep(1)
        path = out / "health.json"
        if not path.exists() or path.stat().st_mtime == before:
            continue
        now = json.loads(path.read_text())
        first_s = time.monotonic() if first_s is None else first_s
        since_s = time.monotonic() - first_s
        link.up = not (away and away[0] <= since_s < away[0] + away[1])
        names = "status", "frames", "keyframes", "keyframes_waiting", "masks_waiting", "workstation"
        state = "up" if link.up else "dead"
        found.append([round(since_s), *(now[name] for name in names), state])
    return found


def main() -> None:
    """Print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--delay-ms", type=float, default=20.0, help="there and back")
    parser.add_argument("--loss", type=float, default=0.01)
    parser.add_argument("--away", type=float, nargs=2, metavar=("BEGIN", "S"))
    parser.add_argument("--out", type=Path, default=Path("runs"))
    words = sys.argv[1:]
    cut = words.index("--") if "--" in words else len(words)
    options = parser.parse_args(words[:cut])
    options.live = words[cut + 1 :]
    with tempfile.TemporaryDirectory() as folder:
        found = measure(options, Path(folder))
    print(json.dumps(found).replace("], [", "],\n ["))


if __name__ == "__main__":
    main()
