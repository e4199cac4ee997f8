"""Tracking of hard recordings (fast, blurred, dark, in a crowd): shares of frames and errors.

    python -m benchmarks.suite.never_lost [NAME ...] [--repeats N] [--set A.B=C]

Inputs are made from those under ../shared/data and from a rendered office, in the folder
``--into``. Cameras are the published ones and the readout time of their sensor. A row is
the median of runs that differ by the grid on which keypoints are spread (see
benchmarks/moving/no_harm.py): frames with a pose, frames of which the pose is WEAK, the longest
loss in frames, errors against the truth (the red kitchen's is of the depth camera: by hand-eye),
and the time of features and tracking. An input without its recording is skipped.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.moving.no_harm import other_keypoints
from benchmarks.pages import table
from benchmarks.paths import SHARED
from benchmarks.suite.hard_sequences import Hardship, make_hard
from bmask_slam.config.configuration import resolve
from bmask_slam.evaluation import evaluate
from bmask_slam.graph.errors import InputError
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.sequences.cameras import read_camera, write_camera
from bmask_slam.system_config import SystemConfig

KINECT_V1 = {"rolling_shutter_s": 0.022, "depth_time_offset_s": -0.0145}
UNKNOWN = {"rolling_shutter_s": 0.0, "depth_time_offset_s": 0.0}
XTION = {"rolling_shutter_s": 0.0248}
READOUT_S = 0.02
"""Of rendered rooms."""


@dataclass(frozen=True)
class Input:
    """A recording of ``SHARED`` or a rendered scene, its changes, and its camera's timing.

    ``stride`` is that of the run; ``hand_eye``: the truth is of another body.
    """

    source: str
    hardship: Hardship | None = None
    stride: int = 1
    timing: dict[str, Any] | None = None
    hand_eye: bool = False


def fast(config: RenderConfig, speed: int) -> RenderConfig:
    """A scene whose images, given out at the rate of the slow one, show so fast a camera."""
    shutter_ms = 1e3 * READOUT_S * speed
    frames = None if config.frames is None else config.frames // speed
    return replace(config, frames=frames, fps=config.fps / speed, rolling_shutter_ms=shutter_ms)


SLOW = {
    "office": RenderConfig("office", frames=300),
    "living_room": RenderConfig("living_room", frames=360),
    "room7": RenderConfig("room", frames=360, seed=7),
}
FAST = {
    f"{name}-x{speed}": fast(config, speed) for name, config in SLOW.items() for speed in (2, 3)
}
RENDERED = {"office": SLOW["office"], **FAST}
"""Rendered sources; all others are recordings."""
INPUTS = {
    "rpy": Input("tum_fr1_rpy", timing=KINECT_V1),
    "rpy-x2": Input("tum_fr1_rpy", stride=2, timing=KINECT_V1),
    "rpy-x3": Input("tum_fr1_rpy", stride=3, timing=KINECT_V1),
    "bonn": Input("bonn_crowd", timing=XTION),
    "kitchen-x3": Input("redkitchen", stride=3, hand_eye=True),
    "kitchen-x3-blur": Input("redkitchen", Hardship(stride=3, shutter=0.6), hand_eye=True),
    "kitchen-box": Input("redkitchen", Hardship(max_frames=200, box_px=11), hand_eye=True),
    **{
        name: Input(name, Hardship(shutter=0.5, fps=30.0), timing={"rolling_shutter_s": READOUT_S})
        for name in FAST
    },
    "rpy-dark": Input("tum_fr1_rpy", Hardship(light=0.2), timing=KINECT_V1),
    "bonn-dark": Input("bonn_crowd", Hardship(light=0.2), timing=XTION),
    "kitchen-dark": Input("redkitchen", Hardship(max_frames=300, light=0.2), hand_eye=True),
    "rpy-body": Input("tum_fr1_rpy", Hardship(body=1 / 6), timing=UNKNOWN),
    "kitchen-body": Input(
        "redkitchen", Hardship(max_frames=300, body=1 / 6), timing=UNKNOWN, hand_eye=True
    ),
    "rpy-depth-noise": Input("tum_fr1_rpy", Hardship(depth_noise=0.006), timing=UNKNOWN),
    "kitchen-depth-noise": Input(
        "redkitchen", Hardship(max_frames=300, depth_noise=0.006), timing=UNKNOWN, hand_eye=True
    ),
    "kitchen": Input("redkitchen", hand_eye=True),
    "office": Input("office"),
}


@dataclass(frozen=True)
class Outcome:
    """Of one run: shares of frames, the longest loss in frames, errors in mm, time in ms."""

    tracked: float
    weak: float
    longest_loss: float
    ate_mm: float
    rpe_mm: float
    tracking_ms: float


def sequence_of(entry: Input, into: Path) -> Path:
    """The folder of an input, made if it does not exist.

    Raises:
        InputError: its recording is not there.
    """
    if entry.source in RENDERED:
        source = into / f"rendered-{entry.source}"
        if not source.is_dir():
            render_sequence(RENDERED[entry.source], source)
    else:
        source = SHARED / entry.source
        if not source.is_dir():
            raise InputError(f"{source}: no such recording")
    if entry.hardship is None:
        return source
    done = entry.hardship
    parts = [entry.source, *vars(done).values()]
    return make_hard(source, done, into / "-".join(map(str, parts)))


def outcome(entry: Input, sequence: Path, settings: list[str]) -> Outcome:
    """Run an input, of which the sequence was made."""
    config = resolve(SystemConfig, None, settings)
    with TemporaryDirectory() as folder:
        out, camera = Path(folder) / "run", None
        if entry.timing:
            camera = Path(folder) / "camera.yaml"
            write_camera(camera, replace(read_camera(sequence / "camera.yaml"), **entry.timing))
        run(RunOptions(sequence, config, out=out, camera=camera, stride=entry.stride, quiet=True))
        return _read(out, sequence, entry.hand_eye)


def _read(out: Path, sequence: Path, hand_eye: bool) -> Outcome:
    frames = Run(out).frames
    status = frames.status
    losses = [len(list(group)) for lost, group in groupby(status, "LOST".__eq__) if lost]
    times_ms = frames.stage_ms["features"] + frames.stage_ms["tracking"]
    try:
        errors = evaluate(out, sequence, with_body=hand_eye)
        ate_m, rpe_m = errors.value("ate_rmse"), errors.value("rpe_trans_rmse_second")
    except (InputError, KeyError):
        ate_m = rpe_m = np.nan
    return Outcome(
        tracked=_posed(out) / len(frames),
        weak=status.count("WEAK") / len(frames),
        longest_loss=max(losses, default=0),
        ate_mm=1e3 * ate_m,
        rpe_mm=1e3 * rpe_m,
        tracking_ms=float(np.nanmedian(times_ms)),
    )


def _posed(out: Path) -> int:
    """Poses of the main trajectory, which may have none."""
    lines = (out / "trajectory.txt").read_text(encoding="utf-8").splitlines()
    return sum(not line.startswith("#") for line in lines)


def row(name: str, outcomes: list[Outcome]) -> tuple[str, ...]:
    """The medians of runs as cells, with the range of the ATE."""
    columns = np.array([[getattr(o, f) for f in Outcome.__dataclass_fields__] for o in outcomes])
    tracked, weak, loss, ate, rpe, ms = np.median(columns, axis=0)
    span = f" ({columns[:, 3].min():.1f}-{columns[:, 3].max():.1f})" if len(outcomes) > 1 else ""
    return (
        name, f"{100 * tracked:.1f}", f"{100 * weak:.1f}", f"{loss:.0f}",
        f"{ate:.1f}{span}", f"{rpe:.1f}", f"{ms:.1f}",
    )  # fmt: skip


HEADER = ("input", "tracked %", "weak %", "longest loss", "ATE mm", "RPE/s mm", "ms a frame")


def main() -> None:
    """Print the table, a row as soon as it is measured."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*INPUTS, []], metavar="NAME")
    parser.add_argument("--into", type=Path, default=Path("runs/hard"), help="folder of the inputs")
    parser.add_argument("--repeats", type=int, default=1)
    parser.add_argument("--masks", type=Path, help="cached masks of the sequences, by their name")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="A.B=C")
    given = parser.parse_args()
    first = True
    for name in given.names or INPUTS:
        entry, settings = INPUTS[name], list(given.settings)
        kind = ["semantics.segmenter.name=none"]
        if given.masks and (given.masks / entry.source).is_dir():
            file = given.masks / entry.source / "annotations.json"
            kind = ["semantics.segmenter.name=precomputed", f"semantics.segmenter.masks={file}"]
        try:
            sequence = sequence_of(entry, given.into)
        except InputError as error:
            print(f"{name}: skipped, {error}", file=sys.stderr, flush=True)
            continue
        outcomes = [
            outcome(entry, sequence, [*kind, *settings, other_keypoints(k)])
            for k in range(given.repeats)
        ]
        lines = table(HEADER, [row(name, outcomes)]).splitlines()
        print("\n".join(lines if first else lines[2:]), flush=True)
        first = False


if __name__ == "__main__":
    main()
