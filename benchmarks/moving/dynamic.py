"""The effect of walking people on the trajectory, with and without the moving-object filter.

    python -m benchmarks.moving.dynamic [--sequences runs/bench] [--segmenter truth] [--seed 6]

The same camera path through the same room is rendered without people, with one, two and four who
walk, and with one who carries a box of no class and pulls a chair along; the first two keep step
with the camera. Sequences that are there already are used as they are. Each is run with nothing,
with the labels of masks alone, with geometry alone, with both, and with the truth of every frame
("ideal"), which shows the effect of occlusion alone. "x clean" compares with the same camera path
without people, run with nothing; "excluded" is the share of the keypoints on people, the box, the
chair while it is pulled, and elsewhere, that were not used. Times of the check, and of keypoint
replenishment, are processor times over all frames. The second table is the coverage of the images
by moving objects.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.moving.moving_points import KINDS, NEAR_PX, CountingSystem, MovingTruth, strip
from benchmarks.pages import table
from bmask_slam.config.configuration import resolve
from bmask_slam.datasets.weights import find_weights
from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.moving.static_features import FeatureReplenishment, StaticFeatures
from bmask_slam.offline.runner import RunOptions, run
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.rendering.sequence import render_sequence
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions, make_segmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig

ROOM = "crowded_office"
SCENES: dict[str, dict[str, Any]] = {
    "nobody": {"people": 0},
    "1 walks": {"people": 1},
    "2 walk": {"people": 2},
    "4 walk": {"people": 4},
    "box and chair": {"people": 1, "carry": True},
}
IDEAL = "ideal"
VARIANTS = {
    "nothing": (False, False),
    "labels": (True, False),
    "geometry": (False, True),
    "both": (True, True),
    IDEAL: (False, False),
}
"""By name, whether labels and geometry are used."""
FPS_HZ = 15.0
PICTURES = 8
WANTED_COVERAGE = (0.15, 0.5)
"""Range of the share of an image that people should cover."""


@dataclass(frozen=True)
class Outcome:
    """A run.

    Attributes:
        ate_mm: root mean square over all frames.
        tracked_share: of the frames.
        excluded: share of keypoints left out, by what they are on; None where it is not there.
        check_ms: median time of the moving-object filter in a frame, and its 95 % quantile.
        mostly_moving: frames in which nearly all keypoints seemed to move.
        covered: share of each picture that moves.
    """

    scene: str
    variant: str
    ate_mm: float
    tracked_share: float
    excluded: dict[str, float | None]
    check_ms: tuple[float, float]
    mostly_moving: int
    covered: list[float]


class IdealSystem(CountingSystem):
    """Excludes the truly moving keypoints in every frame."""

    def _without_moving(self, frame: Frame, features: Features) -> StaticFeatures:
        static, moving = super()._without_moving(frame, features), self._on_moving(frame, features)
        replenishment = FeatureReplenishment(self.camera, self.config.features)
        judge = partial(self._on_moving, frame)
        left = replenishment.replenished(frame, features, moving, judge)
        return StaticFeatures(left, moving, False, static.view)

    def _on_moving(self, frame: Frame, features: Features) -> Mask:
        """Which features (N,) lie on or near what moves in truth."""
        moves = np.any(list(self.truth.masks(frame).values()), axis=0).astype(np.uint8)
        moves = cv2.dilate(moves, np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8))
        columns, rows = np.rint(features.image_pixels).astype(np.int64).T
        return np.asarray(moves[rows, columns] > 0)


def main() -> None:
    """Parse, render, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", type=Path, default=Path("runs/bench"))
    parser.add_argument("--segmenter", default="truth")
    parser.add_argument("--weights")
    parser.add_argument("--seed", type=int, default=6)
    parser.add_argument("--scenes", help="some of them, separated by commas")
    parser.add_argument("--variants", help="some of them, separated by commas")
    parser.add_argument("--set", action="append", default=[], metavar="A.B=C")
    parser.add_argument("--out", type=Path, default=Path("runs/dynamic"))
    arguments = parser.parse_args()
    chosen = arguments.scenes.split(",") if arguments.scenes else list(SCENES)
    variants = arguments.variants.split(",") if arguments.variants else list(VARIANTS)
    outcomes = []
    for scene in chosen:
        folder = rendered(arguments.sequences, scene, arguments.seed)
        outcomes += [measure(folder, scene, variant, arguments) for variant in variants]
    content = [asdict(outcome) for outcome in outcomes]
    (arguments.out / "dynamic.json").write_text(json.dumps(content, indent=1) + "\n")
    print(report(outcomes), coverage(outcomes), sep="\n\n")


def rendered(sequences: Path, scene: str, seed: int) -> Path:
    """The sequence of a scene, rendered if it is not there."""
    what = SCENES[scene]
    name = "carry" if "carry" in what else what["people"]
    folder = sequences / f"{ROOM}-{seed}-{name}"
    if not folder.is_dir():
        render_sequence(RenderConfig(ROOM, seed=seed, fps=FPS_HZ, **what), folder)
    return folder


def measure(folder: Path, scene: str, variant: str, arguments: argparse.Namespace) -> Outcome:
    """Run a sequence; with "labels" or "both" its masks are segmented too."""
    labels, geometry = VARIANTS[variant]
    settings = [f"moving_objects.{k}={v}" for k, v in (("labels", labels), ("geometry", geometry))]
    config = resolve(SystemConfig, None, [*settings, *arguments.set])
    options = SegmenterOptions(arguments.segmenter if labels else "none", arguments.weights)
    segmenter = make_segmenter(options, folder, find_weights)
    systems = []
    frames = len((folder / "rgb.txt").read_text().splitlines()) - 2

    def make(camera: Camera, config: SystemConfig) -> CountingSystem:
        kind = IdealSystem if variant == IDEAL else CountingSystem
        system = kind(camera, config, segmenter)
        systems.append(system.watch(MovingTruth(folder), frames // PICTURES))
        return system

    out = arguments.out / f"{folder.name}-{variant}"
    summary = run(RunOptions(folder, config, out=out, overwrite=True, quiet=True), make)
    metrics = {row["name"]: row["value"] for row in summary.rows}
    system = systems[-1]  # a run that finds another camera begins anew
    if system.pictures:
        cv2.imwrite(str(out.with_suffix(".png")), strip(system.pictures[:PICTURES]))
    check_ms = np.percentile(system.check_ms, [50, 95])
    shares = {kind: system.total(kind).share for kind in (*KINDS, "rest")}
    return Outcome(
        scene=scene,
        variant=variant,
        ate_mm=1e3 * metrics.get("ate_rmse", float("nan")),
        tracked_share=metrics["tracked_share"],
        excluded={k: None if np.isnan(share) else share for k, share in shares.items()},
        check_ms=(float(check_ms[0]), float(check_ms[1])),
        mostly_moving=int(Run(out).frames.mostly_moving.sum()),
        covered=system.covered,
    )


def report(outcomes: Sequence[Outcome]) -> str:
    """The table in Markdown."""
    clean_mm = next(
        (o.ate_mm for o in outcomes if (o.scene, o.variant) == ("nobody", "nothing")), float("nan")
    )
    header = ("scene", "with", "ATE mm", "x clean", "tracked", *(f"{k} left out" for k in KINDS),
              "rest left out", "check ms: median, 95 %")  # fmt: skip
    rows = [
        (
            *(o.scene, o.variant, f"{o.ate_mm:.2f}", f"{o.ate_mm / clean_mm:.2f}"),
            f"{100 * o.tracked_share:.0f} %",
            *("" if s is None else f"{100 * s:.1f} %" for s in o.excluded.values()),
            "{:.2f}, {:.2f}".format(*o.check_ms),
        )
        for o in outcomes
    ]
    return table(header, rows)


def coverage(outcomes: Sequence[Outcome]) -> str:
    """How much of the pictures is covered where anything is, as a table in Markdown."""
    rows = []
    for scene, covered in {o.scene: np.array(o.covered) for o in outcomes}.items():
        if not (there := covered[covered > 0]).size:
            continue
        shares = there.mean(), *np.quantile(there, [0.1, 0.9]), there.max()
        in_range = (there >= WANTED_COVERAGE[0]) & (there <= WANTED_COVERAGE[1])
        rows.append((scene, *(f"{100 * s:.0f} %" for s in (*shares, in_range.mean()))))
    low, high = (f"{100 * share:.0f}" for share in WANTED_COVERAGE)
    header = ("scene", "covered: mean", "10 %", "90 %", "most", f"frames of {low}-{high} %")
    return table(header, rows)


if __name__ == "__main__":
    main()
