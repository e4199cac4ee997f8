"""Tables of real sequences in Markdown: all systems, what is asked, what runs said, README's."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.pages import table
from bmask_slam.runtime.machine import processor

OURS = "bmask-slam"
ORB_SLAM3 = "orb-slam3"
LIBRARIES = {
    ORB_SLAM3: "ORB-SLAM3 RGB-D, as `pyorbslam3` 0.1.1",
    "opencv4": "OpenCV 4 `RgbdOdometry`",
    "opencv5": "OpenCV 5 `Odometry`, colour and depth",
    "open3d-hybrid": "Open3D `compute_rgbd_odometry`, hybrid",
    "open3d-tensor": "Open3D `rgbd_odometry_multi_scale` (tensors)",
}
SHORT = {
    ORB_SLAM3: "ORB-SLAM3",
    "opencv4": "OpenCV 4",
    "opencv5": "OpenCV 5",
    "open3d-hybrid": "Open3D",
    "open3d-tensor": "Open3D, tensors",
}
READOUT_MS, DELAY_MS = 22, 15
BEGIN = "<!-- real: written by benchmarks/cameras/real_sequences.py -->"
END = "<!-- end of real -->"


@dataclass(frozen=True)
class Recording:
    """What is run: of which frames, how that is called, with which options.

    Attributes:
        title: of the frames; the same for all that are run on them.
        options: of ``bmask-slam run``, and shown.
        note: what else is not as published.
        hand_eye: the reference is of another body than the colour camera.
    """

    title: str
    options: tuple[str, ...] = ()
    note: str = ""
    hand_eye: bool = False


RPY = "TUM freiburg1_rpy, 360 frames (Kinect v1)"
RECORDINGS = {
    "rpy": Recording(RPY),
    "rpy-unknown": Recording(RPY, note="folder of another name: the camera's model is not known"),
    "rpy-none": Recording(RPY, ("--segmenter", "none")),
    "bonn": Recording("Bonn crowd, 280 frames (Xtion)"),
    "kitchen": Recording("red kitchen, 600 frames (Kinect v1)", hand_eye=True),
    "office": Recording("rendered office, 300 frames, exact camera"),
    "office-rolling": Recording(
        f"rendered office, rows over {READOUT_MS} ms, depth {DELAY_MS} ms late"
    ),
}


@dataclass(frozen=True)
class Figures:
    """What a system reached on a sequence; None where a number means nothing.

    Attributes:
        name: of RECORDINGS.
        tracked, weak: shares of frames.
        ate_m, hand_eye_m, rpe_m: RMSE; of hand_eye_m with the place of the reference found, and
            of rpe_m where there is a hand_eye_m.
        median_ms, high_ms: a frame's time, 95 % of the frames take less than the second; of a
            library the processor's time, which a busy machine does not change.
        whole_s: of the process, reading and writing too.
        said: the run's line on the camera that it found; of ORB-SLAM3 what its runs have.
        stamp: commit and date.
    """

    name: str
    system: str
    frames: int
    tracked: float
    weak: float | None
    ate_m: float
    hand_eye_m: float | None
    rpe_m: float
    median_ms: float | None
    high_ms: float | None
    whole_s: float
    said: str
    stamp: str


@dataclass(frozen=True)
class Target:
    """What is asked: at most so many millimetres, or at least so many per cent tracked."""

    name: str
    asked: str
    figure: str
    limit: float


TARGETS = (
    Target("rpy", "ATE", "ate_m", 0.010),
    Target("rpy", "RPE a second", "rpe_m", 0.016),
    Target("rpy", "frames tracked", "tracked", 1.0),
    Target("rpy-unknown", "ATE", "ate_m", 0.010),
    Target("bonn", "ATE", "ate_m", 0.010),
    Target("kitchen", "hand-eye ATE", "hand_eye_m", 0.019),
    Target("kitchen", "ATE", "ate_m", 0.041),
)


Rows = dict[tuple[str, str], Figures]
"""By name of the sequence and of the system."""

NOT_IN_README = ("rpy-none",)
MEASURED_ELSEWHERE = {
    "kitchen": ("ORB-SLAM2 RGB-D, ten runs, loops off; not measured here", "100", "46.6-48.4"),
}
"""System, per cent tracked, ATE in mm, of the same frames: see benchmarks/suite/anchors.py."""


def whole_table(rows: Rows) -> str:
    """Every system on every sequence."""
    header = ("sequence", "system", "tracked (weak) %", "ATE mm", "RPE a second mm",
              "ms a frame: median, 95 %", "whole run s")  # fmt: skip
    cells = []
    for title in dict.fromkeys(recording.title for recording in RECORDINGS.values()):
        lines = list(_lines(rows, title))
        cells += [(title if k == 0 else "", *line) for k, line in enumerate(lines)]
    return table(header, cells)


def _lines(rows: Rows, title: str) -> Iterator[tuple[str, ...]]:
    names = [name for name, recording in RECORDINGS.items() if recording.title == title]
    for system in (OURS, *LIBRARIES):
        for name in names:
            if (name, system) in rows:
                yield _line(rows[name, system])
    for name in names:
        if name in MEASURED_ELSEWHERE:
            system, tracked, ate_mm = MEASURED_ELSEWHERE[name]
            yield system, tracked, ate_mm, "", "", ""


def _line(row: Figures) -> tuple[str, ...]:
    weak = "" if row.weak is None else f" ({100 * row.weak:.1f})"
    library = ", ".join(filter(None, (LIBRARIES.get(row.system), row.said)))
    return (
        f"**{OURS}**, {_how(row.name)}" if row.system == OURS else library,
        f"{100 * row.tracked:.1f}{weak}",
        _ate(row), f"{1e3 * row.rpe_m:.1f}",
        "" if row.median_ms is None else f"{row.median_ms:.0f}, {row.high_ms:.0f}",
        f"{row.whole_s:.0f}" if row.system == OURS else "",
    )  # fmt: skip


def _how(name: str) -> str:
    recording = RECORDINGS[name]
    said = [f"`{' '.join(recording.options)}`"] if recording.options else ["default options"]
    return ", ".join(said + [recording.note] * bool(recording.note))


def _ate(row: Figures) -> str:
    hand_eye = "" if row.hand_eye_m is None else f"; hand-eye {1e3 * row.hand_eye_m:.1f}"
    return f"{1e3 * row.ate_m:.1f}{hand_eye}"


def targets_table(rows: Rows) -> str:
    """What is asked of the system, and what was measured."""
    cells = []
    for target in TARGETS:
        row = rows.get((target.name, OURS))
        if row is None:
            continue
        value, share = getattr(row, target.figure), target.figure == "tracked"
        met = value >= target.limit if share else value <= target.limit
        form = "{:.1f} %" if share else "{:.1f} mm"
        factor = 100 if share else 1000
        asked = f"{target.asked}: {'all' if share else f'at most {1e3 * target.limit:g} mm'}"
        how = f"{RECORDINGS[target.name].title}; {_how(target.name)}"
        cells.append((how, asked, form.format(factor * value), "yes" if met else "**no**"))
    exact, rolling = (rows.get((name, OURS)) for name in ("office", "office-rolling"))
    if exact and rolling:
        ratio = rolling.ate_m / exact.ate_m
        title = RECORDINGS["office-rolling"].title
        reached = "yes" if ratio <= 1.5 else "**no**"
        cells.append(
            (title, "ATE: at most 1.5 x that with the exact camera", f"{ratio:.2f} x", reached)
        )
    return table(("sequence", "asked", "measured", "reached"), cells)


def said_by_runs(rows: Rows) -> str:
    """The line of each run on its camera, and when the rows were measured."""
    ours = [row for (_, system), row in rows.items() if system == OURS]
    said = [
        f"- {RECORDINGS[row.name].title}, {_how(row.name)}: {row.said or 'as its file says'}"
        for row in ours
    ]
    when = f"bmask-slam measured at commit {_between(ours)}"
    if others := [row for (_, system), row in rows.items() if system != OURS]:
        when += f"; the libraries at {_between(others)}"
    when += (
        ". Times of OpenCV and Open3D are the processor's; none are given where only wall times "
        "were taken. ORB-SLAM3's are on the clock, of tracking alone, as ours"
    )
    return "What the runs say of the camera:\n\n" + "\n".join(said) + f"\n\n{when}."


def _between(rows: list[Figures]) -> str:
    """The commit and date of the first and of the last that was measured."""
    stamps = sorted({row.stamp for row in rows}, key=lambda stamp: stamp.rpartition(";")[2])
    return " to ".join(dict.fromkeys((stamps[0], stamps[-1])))


def short_table(rows: Rows) -> str:
    """README's table between its markers: the ATE of every system, a line a sequence."""
    header = ("sequence", "frames tracked", "ATE", "RPE a second", "ORB-SLAM3", "OpenCV", "Open3D")
    cells = []
    for name, recording in RECORDINGS.items():
        row = rows.get((name, OURS))
        if row is None or name in NOT_IN_README:
            continue
        first = next(n for n, r in RECORDINGS.items() if r.title == recording.title)
        others = [_best(rows, first, maker) for maker in (ORB_SLAM3, "opencv", "open3d")]
        title = f"{recording.title}; {_how(name)}"
        cells.append((title, f"{100 * row.tracked:.1f} %", f"{_ate(row)} mm",
                      f"{1e3 * row.rpe_m:.1f} mm", *others))  # fmt: skip
    ours = [row for (_, system), row in rows.items() if system == OURS]
    when = f"{processor()}, no GPU used; commit {_between(ours)}; by `make bench`."
    return "\n".join([BEGIN, table(header, cells), "", when, END])


def _best(rows: Rows, name: str, maker: str) -> str:
    """The best ATE of a maker's odometries."""
    found = [row for (n, system), row in rows.items() if n == name and maker in system]
    best = min(found, key=lambda row: row.hand_eye_m or row.ate_m, default=None)
    return f"{_ate(best)} mm" if best else ""
