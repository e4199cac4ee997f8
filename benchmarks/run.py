"""Measure everything: docs/results/benchmarks.md, real-cameras.md; ``make bench`` calls it.

    python -m benchmarks.run                  all sequences; also the table in README.md
    python -m benchmarks.run --quick          the first frames of two sequences, in a minute or two
    python -m benchmarks.run --sequence DIR   a sequence of your own instead

Every run is a process of its own. Rendered sequences are made once, in runs/bench/, and the red
kitchen is measured where ../shared holds it. Only a run over everything touches docs/ and
README.md; the others write their report into runs/bench/pages/, or where --report says.
"""

from __future__ import annotations

import argparse
import json
import logging
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.machine import brisk_ms, describe_commit, describe_machine, load_average, now
from benchmarks.pages import WRITTEN, fill_block
from benchmarks.paths import KITCHEN, RESULTS, ROOT, SHARED
from benchmarks.section_report import REPORTS, make_section, replace_section
from benchmarks.suite.figures import growth_rows, plot_growth, read_growth
from benchmarks.suite.measure import (
    Job,
    Measurement,
    call,
    identical,
    measure,
    published_trajectories,
    render,
    shown,
)
from benchmarks.suite.report import example_block, write_report

logger = logging.getLogger("benchmarks")

RENDERED = {
    "office": ("office-300", ("--frames", "300", "--true-depth")),
    "living_room": ("living_room", ()),
    "corridor": ("corridor", ()),
}
WITHOUT_SUBPIXEL = ("--set", "tracking.subpixel.enabled=false")
LABELLED = "with labels"
GROWING = ("redkitchen", "corridor")
QUICK_FRAMES = 150
OVERVIEW_FRAME = 40


def plan(folders: dict[str, Path], quick: bool) -> list[Job]:
    """The runs: default, repeated, at 10 Hz, without parts, and with the network."""
    if quick:
        options = ("--max-frames", str(QUICK_FRAMES))
        return [Job(name, folder, "default", options) for name, folder in folders.items()]
    jobs = [Job(name, folder) for name, folder in folders.items()]
    first = next(iter(folders))
    jobs.append(Job(first, folders[first], "repeated"))
    if KITCHEN in folders.values():
        jobs.append(Job("redkitchen", KITCHEN, "every 3rd frame", ("--stride", "3")))
    for name, folder in folders.items():
        jobs.append(Job(name, folder, "without sub-pixel registration", WITHOUT_SUBPIXEL))
        jobs.append(Job(name, folder, "no loop closed", ("--set", "loops.enabled=false")))
        if name in ("redkitchen", "office"):
            jobs.append(Job(name, folder, LABELLED, ("--segmenter", "light")))
    return jobs


def find_sequences(arguments: argparse.Namespace) -> tuple[dict[str, Path], list[str]]:
    """Folders by name, rendered where they were missing, and the commands that make them."""
    if arguments.sequence:
        return {folder.resolve().name: folder for folder in arguments.sequence}, []
    folders = {"redkitchen": KITCHEN} if KITCHEN.is_dir() else {}
    commands = []
    for name, (folder_name, options) in RENDERED.items():
        if arguments.quick and name != "office":
            continue
        folders[name] = arguments.work / folder_name
        commands.append(render(folders[name], name, options))
    return folders, commands


def recorded(name: str, folder: Path, work: Path, frames: int) -> Any:
    """A run that records how the graph grows."""
    out = work / "results" / f"{name}-recorded"
    logger.info("running %s, recorded", name)
    call(["-m", "benchmarks.suite.recorded_run", str(folder), "--out", str(out)])
    return read_growth(out / "growth.csv", name, frames)


def measure_all(arguments: argparse.Namespace) -> dict[str, Any]:
    """All measurements of the report, as plain data."""
    load = [load_average()]
    folders, commands = find_sequences(arguments)
    yardstick = next(iter(folders.values()))
    brisk = [brisk_ms(yardstick)]
    measurements = [measure(job, arguments.work) for job in plan(folders, arguments.quick)]
    brisk.append(brisk_ms(yardstick))
    load.append(load_average())
    growing = [name for name in folders if name in GROWING or arguments.sequence]
    frames = {m.sequence: m.frames for m in measurements if m.variant == "default"}
    grown = [
        recorded(name, folders[name], arguments.work, frames[name])
        for name in growing
        if not arguments.quick
    ]
    if grown:
        plot_growth(grown, image_path(arguments))
    if "office" in folders and not arguments.quick:
        draw_overview(folders["office"], arguments)
    noise = {}
    if "office" in folders and (folders["office"] / "depth_true").is_dir():
        command = ["-m", "benchmarks.suite.keypoint_noise", str(folders["office"]), "--json"]
        noise = json.loads(call(command))
    return {
        "machine": describe_machine(),
        "commit": describe_commit(WRITTEN),
        "date": now(),
        "command": command_line(arguments),
        "render_commands": commands,
        "load": load,
        "brisk_ms": brisk,
        "brisk_sequence": shown(yardstick),
        "runs": [asdict(m) for m in measurements],
        "identical": repeats(measurements),
        "growth": {growth.sequence: growth_rows(growth) for growth in grown},
        "noise": noise,
        "trajectories": published_trajectories(),
    }


def repeats(measurements: list[Measurement]) -> dict[str, bool]:
    """For each sequence that was run twice, whether both trajectories have the same bytes."""
    first = {m.sequence: m for m in measurements if m.variant == "default"}
    again = [m for m in measurements if m.variant == "repeated"]
    return {m.sequence: identical(first[m.sequence], m) for m in again}


def draw_overview(folder: Path, arguments: argparse.Namespace) -> None:
    """The picture at the top of README.md, from the office's run with labels."""
    run = arguments.work / "results" / f"office-{LABELLED}".replace(" ", "-")
    call(["-m", "bmask_slam", "map", str(run), "--quiet"])
    out = image_path(arguments).with_name("overview.png")
    command = ["-m", "benchmarks.suite.picture", str(run), str(folder), "--out", str(out)]
    call([*command, "--frame", str(OVERVIEW_FRAME)])


def image_path(arguments: argparse.Namespace) -> Path:
    """Path of the growth figure: ``images`` beside the report's folder."""
    path: Path = arguments.report.parent.parent / "images" / "graph_growth.png"
    return path


def command_line(arguments: argparse.Namespace) -> str:
    """The command that repeats this report."""
    flags = ["--quick"] * arguments.quick
    for folder in arguments.sequence:
        flags += ["--sequence", shown(folder)]
    return f'make bench BENCH="{" ".join(flags)}"' if flags else "make bench"


def parse() -> argparse.Namespace:
    """The command line, with the report's path filled in."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few frames of two sequences")
    parser.add_argument(
        "--sequence", type=Path, action="append", default=[], help="instead; may be repeated"
    )
    parser.add_argument("--work", type=Path, default=ROOT / "runs" / "bench", help="for runs")
    parser.add_argument("--report", type=Path, help="file to write (default: see above)")
    parser.add_argument(
        "--report-only", action="store_true", help="write the report of the last run again"
    )
    arguments = parser.parse_args()
    arguments.whole = not (arguments.quick or arguments.sequence or arguments.report)
    if arguments.report is None:
        folder = RESULTS if arguments.whole else arguments.work / "pages"
        arguments.report = folder / "benchmarks.md"
    return arguments


def main() -> None:
    """Measure, write the report, and the README's table if everything was measured."""
    arguments = parse()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    logging.getLogger("bmask_slam").setLevel(logging.WARNING)
    arguments.work.mkdir(parents=True, exist_ok=True)
    store = arguments.work / "results.json"
    if not arguments.report_only:
        store.write_text(json.dumps(measure_all(arguments), indent=1), encoding="utf-8")
    results = json.loads(store.read_text(encoding="utf-8"))
    write_report(results, arguments.report)
    if arguments.whole:
        fill_block(ROOT / "README.md", example_block(results))
        measure_real_cameras(arguments)
    print(arguments.report)


def measure_real_cameras(arguments: argparse.Namespace) -> None:
    """The tables of docs/results/real-cameras.md, dense.md and README, and labels of real rooms.

    None where there are no data.
    """
    if not SHARED.is_dir():
        return
    report, command = REPORTS["real-cameras"], ["-m", "benchmarks.cameras.real_sequences"]
    if not arguments.report_only:
        rooms = make_section(REPORTS["semantics"], "rooms", arguments.work)
        replace_section(REPORTS["semantics"], rooms)
        print(rooms)
        for section in ("table", "loops"):
            replace_section(report, make_section(report, section, arguments.work))
        dense = REPORTS["dense"]
        replace_section(dense, make_section(dense, "rooms", arguments.work))
    printed = ["--report-only", "--work", str(arguments.work), "--readme", str(ROOT / "README.md")]
    print(call([*command, *printed]).partition("\n\n")[0])


if __name__ == "__main__":
    main()
