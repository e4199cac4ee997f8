"""Run benchmarks and write their output to a page under docs/results/.

    python -m benchmarks.section_report graph [--only loops,session] [--sequences runs/bench]

Each section of a page holds the command, what it printed, and a line with machine, commit and date.
With ``--only`` the other sections are kept. README.md and docs/results/benchmarks.md are
written by ``make bench``.
"""

from __future__ import annotations

import argparse
import re
import time
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.machine import describe_commit, now
from benchmarks.pages import WRITTEN
from benchmarks.paths import RESULTS
from benchmarks.suite.measure import call
from bmask_slam.runtime.machine import processor


@dataclass(frozen=True)
class Report:
    """A page of sections by name: each has a title, a benchmark and its arguments, pictures.

    Attributes:
        sections: title and command by name; a section without command is written by hand.
        pictures: of a section, captions by their names in docs/images.
        markdown: sections of which the output is Markdown, and not put into a block of code.
    """

    path: Path
    title: str
    sections: dict[str, tuple[str, str]]
    pictures: dict[str, dict[str, str]] = field(default_factory=dict)
    markdown: frozenset[str] = frozenset()

    @property
    def head(self) -> str:
        """The begin of the page."""
        return (
            f"# {self.title}\n\nWritten by `python -m benchmarks.section_report {self.path.stem}`; "
            "a section with a command is what that printed.\n"
        )


REPORTS = {
    "graph": Report(RESULTS / "graph.md", "Results: the factor graph", {
        "session": ("A long session with bounded cost", "graph.long_session"),
        "loops": (
            "Loops closed, and wrong ones survived", "loops.loop_closing {sequences}/corridor"
        ),
        "loop-limits": (
            "How much closed loops can take away",
            "loops.loop_limits {sequences}/results/corridor-default "
            "{sequences}/results/corridor-no-loop-closed --reference {sequences}/corridor",
        ),
        "rounds": ("Round after round", "loops.corridor_rounds --out {sequences}/rounds"),
        "pose-graph-times": (
            "Pose graphs, time beside plain GTSAM", "graph.pose_graphs --methods lm --seeds 0"
        ),
        "pose-graphs": ("Pose graphs, clean and with wrong loops", "graph.pose_graphs"),
        "kills": (
            "Killed and resumed",
            "graph.kill_and_resume {sequences}/office-300 --every 30 --kills 10 --max-frames 150",
        ),
        "calibration": (
            "Self-calibration", "calibration.self_calibration --out {sequences}/calibration"
        ),
        "kitchen-reference": (
            "The red kitchen's reference, judged by its images",
            "calibration.kitchen_reference {sequences}/calibration/given",
        ),
        "covariances": (
            "How honest the covariances are",
            "graph.covariances --runs 200 --sequence {sequences}/living_room",
        ),
    }),
    "scale": Report(RESULTS / "scale.md", "Results: a building, a day, and beyond", {
        "building": (
            "Three storeys of rooms that look alike", "scale.building --work {sequences}/building"
        ),
        "reading": ("What the building shows", ""),
        "day": (
            "A day of a robot, by descriptors and poses",
            "scale.day --picture docs/images/day.png",
        ),
        "revisits": (
            "A real room seen again and again", "loops.revisits ../shared/data/redkitchen"
        ),
        "far": ("At 100 km, on paper", ""),
    }, pictures={
        "day": {"day.png": "Times, memory and file, keyframes and loops over the day"},
    }, markdown=frozenset({"revisits"})),
    "live": Report(RESULTS / "live.md", "Results: the live loop", {
        "speed": ("Red kitchen, offline and live", "live.speed --repeats 1"),
        "session": (
            "Thirty minutes", "live.session {sequences}/office-300 --minutes 30 --hz 10"
        ),
        "soak": (
            "An hour at 30 Hz, in several places",
            "live.soak {sequences}/office-300 {sequences}/living_room --minutes 60 "
            "--picture docs/images/live_soak.png",
        ),
        "turns": ("Fast turns", ""),
        "peak": ("Peak of 600 frames", ""),
        "present_poses": ("Poses and velocities as they are given out", "live.present_poses"),
        "memory": ("Memory of the map", "live.map_memory ../shared/data/redkitchen --frames 600"),
    }, pictures={
        "soak": {"live_soak.png": "Latency, memory, descriptors and keyframes over the hour"},
    }),
    "semantics": Report(RESULTS / "semantics.md", "Results: masks, labels, moving things", {
        "photographs": (
            "Masks of photographs that no training saw", "semantics.segmentation photographs"
        ),
        "stuff": ("A class for every pixel, on NYU Depth v2's test images", "semantics.stuff"),
        "cost": ("Time and memory of the networks", "semantics.segmentation cost"),
        "beside": (
            "Beside torchvision's network",
            "semantics.beside_torchvision --environment {sequences}/torchvision",
        ),
        "labels-truth": (
            "Labels and objects from true masks",
            "semantics.labels {sequences}/office-300 {sequences}/room-930 {sequences}/room-931",
        ),
        "rooms": (
            "Labels and objects of real rooms, judged by eye",
            "semantics.real_rooms --out {sequences}/rooms",
        ),
        "mounted": (
            "A camera mounted sideways or upside down",
            "semantics.mounted --out {sequences}/mounted",
        ),
        "surfaces": (
            "Surfaces of real rooms, judged by eye",
            "semantics.room_surfaces {sequences}/rooms/redkitchen {sequences}/rooms/bonn_crowd",
        ),
        "store": ("Time of the label store", "semantics.label_store"),
        "dynamic": (
            "People who walk, a carried box and a pulled chair",
            "moving.dynamic --sequences {sequences} --segmenter light --seed 6 "
            "--out {sequences}/dynamic",
        ),
        "dynamic-again": (
            "The same with other people",
            "moving.dynamic --sequences {sequences} --segmenter light --seed 7 "
            "--out {sequences}/dynamic-again",
        ),
        "people": (
            "Three rooms full of people, three runs each",
            "moving.dynamic_seeds --sequences {sequences} --seeds 6,7,8",
        ),
        "harm": (
            "What the semantics cost where nothing moves",
            "moving.no_harm {sequences}/office-300 {sequences}/living_room --rooms 20-31 "
            "--rendered {sequences}",
        ),
        "harm-kitchen": (
            "The same in the red kitchen, its reference of a point beside the camera",
            "moving.no_harm ../shared/data/redkitchen --hand-eye",
        ),
        "pairs": ("A real man who walks, by geometry alone", "moving.dynamic_pairs"),
        "pairs-labels": (
            "The same with the network's masks",
            "moving.dynamic_pairs --segmenter light",
        ),
        "composited": (
            "A real man put into a real recording",
            "moving.composited --segmenter light --out {sequences}/composited",
        ),
    }, markdown=frozenset({"rooms"})),
    "mapping": Report(RESULTS / "mapping.md", "Results: the dense map", {
        "dense": ("Depth, surface, labels and time", "mapping.dense {sequences}/dense"),
        "session": (
            "Memory over a long session",
            "mapping.dense_session {sequences}/dense/office --keyframes 900",
        ),
        "pictures": ("What it looks like", "mapping.dense_pictures {sequences}/dense docs/images"),
    }, {
        "pictures": {
            "dense_kitchen.jpg": "The red kitchen; labels by light masks in YOLOX-Nano's boxes",
            "dense_kitchen_mesh.jpg": "Its mesh, lit from the camera, and the cloud",
            "dense_kitchen_plan.png": "Its floor plan: floor, what stands on it, the camera's path",
            "dense_office.jpg": "A rendered office: cloud and labels",
        },
    }),
    "dense": Report(RESULTS / "dense.md", "Results: the surface beside Open3D's", {
        "rooms": (
            "Real rooms, and rendered ones", "mapping.surface_compare --work {sequences}"
        ),
        "reading": ("What the figures say", ""),
        "goals": ("Goals reached and missed", ""),
        "growing": ("The surface that grows", ""),
    }, markdown=frozenset({"rooms"})),
    "real-cameras": Report(RESULTS / "real-cameras.md", "Results: real cameras", {
        "table": ("Real sequences", "cameras.real_sequences --work {sequences}"),
        "reading": ("What the figures say", ""),
        "parallel": ("In one process or three", ""),
        "orb": ("Hard inputs beside ORB-SLAM3", ""),
        "hard": ("Hard inputs: never lost", ""),
        "loops": ("Loop closures", "loops.loop_edges --work {sequences}"),
        "wrong": ("Wrong cameras", "suite.wrong_cameras"),
        "stamps": ("Depth that is off its stamps", ""),
    }, markdown=frozenset({"table", "orb", "hard", "loops", "wrong", "stamps"})),
}  # fmt: skip


def make_section(report: Report, name: str, sequences: Path) -> str:
    """Run a benchmark; returns its section."""
    title, given = report.sections[name]
    module, *arguments = given.format(sequences=sequences).split()
    command = ["-m", f"benchmarks.{module}", *arguments]
    typed = f"python {' '.join(command)}"
    print(f"{title}: {typed}", flush=True)
    commit, begin_s = describe_commit(WRITTEN), time.perf_counter()
    output = call(command)
    wall_s = time.perf_counter() - begin_s
    stamp = f"{processor()}; commit {commit}; {now()}; {wall_s:.0f} s."
    printed = output.rstrip()
    if name not in report.markdown:
        printed = f"```\n{printed}\n```"
    captions = report.pictures.get(name, {})
    pictures = "".join(
        f"\n![{text}](../images/{file})\n{text}.\n" for file, text in captions.items()
    )
    return f"## {title}\n\n`{typed}`\n\n{printed}\n\n{stamp}\n{pictures}"


def replace_section(report: Report, new: str) -> None:
    """Write a section into its page, in place of the old one."""
    old = report.path.read_text() if report.path.exists() else report.head
    parts = {
        part.split("\n", 1)[0]: part.rstrip() + "\n\n"
        for part in re.split(r"(?m)^(?=## )", old)[1:]
    }
    parts[new.split("\n", 1)[0]] = new.rstrip() + "\n\n"
    titles = [f"## {title}" for title, _ in report.sections.values()]
    body = "".join(parts[title] for title in titles if title in parts)
    report.path.write_text(f"{report.head}\n{body.rstrip()}\n")


def main() -> None:
    """Write a page, or some of its sections."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("report", choices=REPORTS)
    parser.add_argument("--only", help="some of its sections, such as loops,session")
    parser.add_argument("--sequences", type=Path, default=Path("runs/bench"))
    arguments = parser.parse_args()
    report = REPORTS[arguments.report]
    commands = [name for name, (_, command) in report.sections.items() if command]
    for name in arguments.only.split(",") if arguments.only else commands:
        replace_section(report, make_section(report, name, arguments.sequences))


if __name__ == "__main__":
    main()
