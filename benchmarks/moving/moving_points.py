"""Counts of excluded keypoints against the moving objects of a rendered sequence, and pictures.

Red keypoints are excluded as moving, green ones used. Moving objects are outlined in yellow.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Array, Image, Mask
from bmask_slam.moving.static_features import StaticFeatures
from bmask_slam.rendering.annotations import CATEGORY_IDS
from bmask_slam.rendering.things.people import PULLED_S
from bmask_slam.sequences.frame import Frame
from bmask_slam.system import SlamSystem
from bmask_slam.tracking.results import Tracked

NEAR_PX = 6
"""Keypoints nearer to a border are not counted."""
KINDS = ("person", "box", "chair")


class MovingTruth:
    """Moving objects in the frames of a rendered sequence: people, a carried box, a chair."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        content = json.loads((folder / "annotations.json").read_text())
        labels = {a["instance_id"]: a["category_id"] for a in content["annotations"]}
        self._labels = labels
        self._people = [i for i, label in labels.items() if label == CATEGORY_IDS["person"]]

    def masks(self, frame: Frame) -> dict[str, Mask]:
        """Masks (H, W) by kind; the chair only while it is pulled.

        A box is in no annotation, and the instance after it is the chair that is pulled.
        """
        name = Path(frame.name).name
        drawn = cv2.imread(str(self.folder / "instances" / name), cv2.IMREAD_UNCHANGED)
        boxes = sorted(set(np.unique(drawn).tolist()) - {0} - self._labels.keys())
        found = {"person": np.isin(drawn, self._people), "box": np.isin(drawn, boxes)}
        pulled = PULLED_S[0] <= frame.timestamp_s <= PULLED_S[1]
        chairs = [self._people[0] - 1] if self._people and pulled else []
        chairs = [i for i in chairs if self._labels.get(i) == CATEGORY_IDS["chair"]]
        return found | {"chair": np.isin(drawn, chairs)}


@dataclass(frozen=True)
class Count:
    """Numbers of keypoints on an object, and of excluded ones."""

    on: int = 0
    excluded: int = 0

    def __add__(self, other: Count) -> Count:
        return Count(self.on + other.on, self.excluded + other.excluded)

    @property
    def share(self) -> float:
        """The share of excluded keypoints; NaN without keypoints."""
        return self.excluded / self.on if self.on else float("nan")


Counts = Mapping[str, Count]


def count(pixels: Array, moving: Mask, masks: Mapping[str, Mask]) -> dict[str, Count]:
    """Keypoints (N, 2) well inside of each mask, and well outside of all ("rest")."""
    window = np.ones((2 * NEAR_PX + 1, 2 * NEAR_PX + 1), np.uint8)
    columns, rows = np.rint(pixels).astype(np.int64).reshape(-1, 2).T
    any_ = np.any(list(masks.values()), axis=0)
    sides = {kind: cv2.erode(m.astype(np.uint8), window) > 0 for kind, m in masks.items()}
    sides["rest"] = cv2.dilate(any_.astype(np.uint8), window) == 0
    on = {kind: side[rows, columns] for kind, side in sides.items()}
    return {kind: Count(int(o.sum()), int((o & moving).sum())) for kind, o in on.items()}


def picture(frame: Frame, static: tuple[Array, Mask], masks: Mapping[str, Mask]) -> Image:
    """A frame with its keypoints and outlines of moving objects, half size, BGR."""
    drawn = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR)
    moves = np.any(list(masks.values()), axis=0).astype(np.uint8)
    outlines, _ = cv2.findContours(moves, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    cv2.drawContours(drawn, outlines, -1, (0, 220, 255), 2)
    for (u, v), moving in zip(*static, strict=True):
        colour = (0, 0, 255) if moving else (0, 220, 0)
        cv2.circle(drawn, (round(u), round(v)), 3, colour, -1)
    return np.asarray(cv2.resize(drawn, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


class CountingSystem(SlamSystem):
    """The system; counts keypoints in every frame, and draws every ``every``-th.

    ``check_ms`` is the processor's time of a frame's dynamic check and
    of keypoint replenishment. ``covered`` is the share of each frame that moving objects cover.
    """

    truth: MovingTruth
    every: int

    def watch(self, truth: MovingTruth, every: int) -> CountingSystem:
        """Start counting."""
        self.truth, self.every = truth, every
        self.counts: list[dict[str, Count]] = []
        self.pictures: list[Image] = []
        self.check_ms: list[float] = []
        self.covered: list[float] = []
        return self

    def total(self, kind: str) -> Count:
        """The sum over all frames except the first, which has no earlier view."""
        return sum((c[kind] for c in self.counts[1:]), Count())

    def _without_moving(self, frame: Frame, features: Features) -> StaticFeatures:
        begun_s = time.thread_time()
        static = super()._without_moving(frame, features)
        self.check_ms.append(1e3 * (time.thread_time() - begun_s))
        masks = self.truth.masks(frame)
        keypoints = features.image_pixels, static.moving
        self.counts.append(count(*keypoints, masks))
        self.covered.append(float(np.any(list(masks.values()), axis=0).mean()))
        if frame.index % self.every == self.every // 2:
            self.pictures.append(picture(frame, keypoints, masks))
        return static

    def _learn_motion(self, frame: Frame, tracked: Tracked, static: StaticFeatures) -> bool:
        begun_s = time.thread_time()
        restored = super()._learn_motion(frame, tracked, static)
        self.check_ms[-1] += 1e3 * (time.thread_time() - begun_s)
        return restored


def strip(pictures: list[Image], columns: int = 4) -> Image:
    """Pictures, one or more, in rows; an incomplete last row is dropped."""
    columns = min(columns, len(pictures))
    rows = range(0, len(pictures) - columns + 1, columns)
    return np.vstack([np.hstack(pictures[k : k + columns]) for k in rows])
