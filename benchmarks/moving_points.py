"""Which keypoints were taken for moving, against the people in a rendered sequence.

    python benchmarks/moving_points.py SEQUENCE --segmenter none --strip moving.png

Red in the picture: left out as moving; green: used. Masks of people are outlined in yellow.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from graph.geometry import Array
from semantics.segmenter import CocoSegmenter
from semantics.segmenter_table import SegmenterOptions, make_segmenter
from slam.configuration import resolve
from slam.dynamics import Sifted
from slam.features import Features
from slam.frame import Frame
from slam.sequences import open_sequence
from slam.system import SlamSystem
from slam.system_config import SystemConfig

NEAR_PX = 6
"""Keypoints so near to a person's border count for neither side."""


@dataclass(frozen=True)
class Sight:
    """A frame's keypoints (N, 2), which of them were left out (N,), and its picture."""

    frame: Frame
    pixels: Array
    moving: NDArray[np.bool_]


class WatchedSystem(SlamSystem):
    """The system; ``sights`` keeps what was left out of every frame."""

    sights: list[Sight]

    def _sift(self, frame: Frame, features: Features) -> Sifted:
        sifted = super()._sift(frame, features)
        self.sights.append(Sight(frame, features.image_pixels, sifted.moving))
        return sifted


@dataclass(frozen=True)
class Score:
    """Keypoints on people and off them, and how many of either were left out."""

    on_people: int
    found: int
    off_people: int
    wrong: int


def people_in(truth: CocoSegmenter, frame: Frame) -> NDArray[np.bool_]:
    """(H, W) the pixels of people in a frame, by a sequence's annotations."""
    person = truth.labels.number("person")
    masks = [i.mask for i in truth.segment(frame.rgb, frame.name) if i.label == person]
    return np.any([np.zeros(frame.rgb.shape[:2], bool), *masks], axis=0)


def score(sight: Sight, people: NDArray[np.bool_]) -> Score:
    """Count keypoints well inside and well outside of the people."""
    window = np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
    columns, rows = np.rint(sight.pixels).astype(np.int64).reshape(-1, 2).T
    on = cv2.erode(people.astype(np.uint8), window)[rows, columns] > 0
    off = cv2.dilate(people.astype(np.uint8), window)[rows, columns] == 0
    moving = sight.moving
    return Score(int(on.sum()), int((on & moving).sum()), int(off.sum()), int((off & moving).sum()))


def picture(sight: Sight, people: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A frame with its keypoints and the outline of its people, half size."""
    drawn = cv2.cvtColor(sight.frame.rgb, cv2.COLOR_RGB2BGR)
    outlines, _ = cv2.findContours(
        people.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE
    )
    cv2.drawContours(drawn, outlines, -1, (0, 220, 255), 2)
    for (u, v), moving in zip(sight.pixels, sight.moving, strict=True):
        colour = (0, 0, 255) if moving else (0, 220, 0)
        cv2.circle(drawn, (round(u), round(v)), 3, colour, -1)
    return np.asarray(cv2.resize(drawn, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequence", type=Path)
    parser.add_argument("--segmenter", default="none")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--set", action="append", default=[])
    parser.add_argument("--strip", type=Path, help="PNG with a few of the frames")
    options = parser.parse_args()
    sequence = open_sequence(options.sequence)
    truth = CocoSegmenter(options.sequence / "annotations.json")
    segmenter = make_segmenter(SegmenterOptions(options.segmenter), options.sequence)
    system = WatchedSystem(sequence.camera, resolve(SystemConfig, None, options.set), segmenter)
    system.sights = []
    for frame in sequence.frames():
        if options.frames is not None and frame.index >= options.frames:
            break
        system.process(frame)
    people = [people_in(truth, sight.frame) for sight in system.sights]
    scores = [score(s, p) for s, p in zip(system.sights, people, strict=True)]
    for k in range(0, len(scores), 10):
        print(k, scores[k])
    on, off = sum(s.on_people for s in scores), sum(s.off_people for s in scores)
    print(f"on people, left out: {sum(s.found for s in scores) / max(on, 1):.3f} of {on}")
    print(f"off people, left out: {sum(s.wrong for s in scores) / max(off, 1):.4f} of {off}")
    if options.strip:
        chosen = [k for k in np.argsort([-p.sum() for p in people]) if people[k].any()]
        chosen = sorted(chosen[:: max(len(chosen) // 8, 1)][:8])
        drawn = [picture(system.sights[k], people[k]) for k in chosen]
        rows = [np.hstack(drawn[k : k + 4]) for k in range(0, len(drawn) - 3, 4)]
        cv2.imwrite(str(options.strip), np.vstack(rows))


if __name__ == "__main__":
    main()
