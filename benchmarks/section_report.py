"""Run benchmarks one after the other and keep what they print in a report under docs/.

    python benchmarks/section_report.py graph [--only loops,session] [--sequences runs/bench]
    python benchmarks/section_report.py --stale [graph]

What a benchmark prints stands in the report as it is, below the command. With ``--only`` the other
sections stay as they were; with ``--stale`` those that are not there, or older than the code that
makes them, are made anew, in one report or in all. README.md and docs/benchmarks.md are written by
``make bench``.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks.freshness import PAGES, code_print, sections  # noqa: E402
from benchmarks.machine import describe_commit, now  # noqa: E402
from bmask_slam.runtime.machine import processor  # noqa: E402


@dataclass(frozen=True)
class Report:
    """A page of sections by name: each has a title, a command of this folder and pictures."""

    path: Path
    title: str
    sections: dict[str, tuple[str, str]]
    pictures: dict[str, dict[str, str]] = field(default_factory=dict)
    """Of a section: captions by their names in docs/images."""

    @property
    def head(self) -> str:
        """How the page begins."""
        return (
            f"# {self.title}\n\nWritten by `python benchmarks/section_report.py {self.path.stem}`; "
            "each section is what its command printed.\n"
        )


REPORTS = {
    "graph": Report(ROOT / "docs" / "graph.md", "What the graph reaches", {
        "session": ("A long session with bounded cost", "long_session.py"),
        "loops": ("Loops closed, and wrong ones survived", "loop_closing.py {sequences}/corridor"),
        "loop-limits": (
            "How much closed loops can take away",
            "loop_limits.py {sequences}/results/corridor-default "
            "{sequences}/results/corridor-no-loop-closed --reference {sequences}/corridor",
        ),
        "rounds": ("Round after round", "corridor_rounds.py --out {sequences}/rounds"),
        "pose-graphs": ("Pose graphs, clean and with wrong loops", "pose_graphs.py"),
        "kills": (
            "Killed and resumed",
            "kill_and_resume.py {sequences}/office-300 --every 30 --kills 10 --max-frames 150",
        ),
        "calibration": ("Self-calibration", "calibration.py --out {sequences}/calibration"),
        "kitchen-reference": (
            "The red kitchen's reference, judged by its images",
            "kitchen_reference.py {sequences}/calibration/given",
        ),
        "covariances": (
            "How honest the covariances are",
            "covariances.py --runs 200 --sequence {sequences}/living_room",
        ),
    }),
    "live": Report(ROOT / "docs" / "live.md", "What the live loop reaches", {
        "speed": ("Red kitchen, offline and live", "live.py --repeats 1"),
        "session": (
            "Thirty minutes", "live_session.py {sequences}/office-300 --minutes 30 --hz 10"
        ),
    }),
    "semantics": Report(ROOT / "docs" / "semantics.md", "What the semantics reach", {
        "photographs": (
            "Masks of photographs", "segmentation.py photographs --weights {sequences}/light-{{}}"
        ),
        "rooms": ("Masks of rendered rooms", "segmentation.py rooms --rooms {sequences}/rooms"),
        "cost": ("Time and memory of the networks", "segmentation.py cost"),
        "beside": (
            "Beside torchvision's network",
            "beside_torchvision.py --environment {sequences}/torchvision",
        ),
        "labels-truth": (
            "Labels and objects from true masks",
            "labels.py {sequences}/office-300 {sequences}/room-930 {sequences}/room-931",
        ),
        "labels": (
            "Labels and objects from the network's masks",
            "labels.py {sequences}/office-300 {sequences}/room-930 {sequences}/room-931 "
            "--segmenter light",
        ),
        "store": ("Time of the label store", "label_store.py"),
        "dynamic": (
            "People who walk, a carried box and a pulled chair",
            "dynamic.py --sequences {sequences} --segmenter light --seed 6 "
            "--out {sequences}/dynamic",
        ),
        "dynamic-again": (
            "The same with other people",
            "dynamic.py --sequences {sequences} --segmenter light --seed 7 "
            "--out {sequences}/dynamic-again",
        ),
        "people": (
            "Three rooms full of people, three runs each",
            "dynamic_seeds.py --sequences {sequences} --seeds 6,7,8",
        ),
        "harm": (
            "What the semantics cost where nothing moves",
            "no_harm.py {sequences}/office-300 {sequences}/living_room --rooms 20-31 "
            "--rendered {sequences}",
        ),
        "harm-kitchen": (
            "The same in the red kitchen, its reference of a point beside the camera",
            "no_harm.py ../shared/data/redkitchen --hand-eye",
        ),
        "pairs": ("A real man who walks, by geometry alone", "dynamic_pairs.py"),
        "pairs-labels": (
            "The same with the network's masks",
            "dynamic_pairs.py --segmenter light",
        ),
        "composited": (
            "A real man put into a real recording",
            "composited.py --segmenter light --out {sequences}/composited",
        ),
    }),
    "mapping": Report(ROOT / "docs" / "mapping.md", "What the dense map reaches", {
        "dense": ("Depth, surface, labels and time", "dense.py {sequences}/dense"),
        "loop": ("Submaps follow a loop closure", "dense_session.py loop {sequences}/dense/office"),
        "session": (
            "Memory over a long session",
            "dense_session.py session {sequences}/dense/office --keyframes 900",
        ),
        "pictures": ("What it looks like", "dense_pictures.py {sequences}/dense docs/images"),
    }, {
        "pictures": {
            "dense_kitchen.jpg": "The red kitchen; labels by light masks in YOLOX-Nano's boxes",
            "dense_kitchen_mesh.jpg": "Its mesh, lit from the camera, and the cloud",
            "dense_kitchen_plan.png": "Its floor plan: floor, what stands on it, the camera's path",
            "dense_office.jpg": "A rendered office: cloud and labels",
        },
    }),
}  # fmt: skip


def make_section(report: Report, name: str, sequences: Path) -> str:
    """Run a benchmark; its section."""
    title, command = report.sections[name]
    command = f"benchmarks/{command.format(sequences=sequences)}"
    print(f"{title}: python {command}", flush=True)
    commit = describe_commit(tuple(str(page.relative_to(ROOT)) for page in PAGES))
    code = code_print(ROOT / command.split()[0])
    begin_s = time.perf_counter()
    done = subprocess.run(
        [sys.executable, *command.split()], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"{command} failed:\n{done.stderr[-2000:]}")
    wall_s = time.perf_counter() - begin_s
    when = f"{processor()}; commit {commit}; code {code}; {now()}; {wall_s:.0f} s."
    captions = report.pictures.get(name, {})
    pictures = "".join(f"\n![{text}](images/{file})\n{text}.\n" for file, text in captions.items())
    printed = f"```\n{done.stdout.rstrip()}\n```"
    return f"## {title}\n\n`python {command}`\n\n{printed}\n\n{when}\n{pictures}"


def replace_section(report: Report, new: str) -> None:
    """Put a section into its page, in the place of the old one."""
    old = report.path.read_text() if report.path.exists() else report.head
    parts = {
        part.split("\n", 1)[0]: part.rstrip() + "\n\n"
        for part in re.split(r"(?m)^(?=## )", old)[1:]
    }
    parts[new.split("\n", 1)[0]] = new.rstrip() + "\n\n"
    titles = [f"## {title}" for title, _ in report.sections.values()]
    body = "".join(parts[title] for title in titles if title in parts)
    report.path.write_text(f"{report.head}\n{body.rstrip()}\n")


def stale(report: Report) -> list[str]:
    """Names of the sections that are missing or older than the code that makes them."""
    written = sections(report.path) if report.path.exists() else []
    fresh = {section.title for section in written if not section.stale}
    return [name for name, (title, _) in report.sections.items() if title not in fresh]


def main() -> None:
    """Write a report, or renew some of its sections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", choices=REPORTS, nargs="?")
    parser.add_argument("--only", help="some of its sections, such as loops,session")
    parser.add_argument("--stale", action="store_true", help="those that need it, of all reports")
    parser.add_argument("--sequences", type=Path, default=Path("runs/bench"))
    arguments = parser.parse_args()
    if not arguments.report and not arguments.stale:
        parser.error("which report? Or --stale")
    for report in [REPORTS[arguments.report]] if arguments.report else REPORTS.values():
        names = stale(report) if arguments.stale else list(report.sections)
        for name in arguments.only.split(",") if arguments.only else names:
            replace_section(report, make_section(report, name, arguments.sequences))


if __name__ == "__main__":
    main()
