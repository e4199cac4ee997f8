"""Boxes from a YOLOX detector (Ge et al. 2021) in an ONNX file, run by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import iou
from bmask_slam.semantics.network.nms import grouped_nms

STRIDES = (8, 16, 32)
SIZES_PX = (416, 640)
"""Input sizes of the published networks: of Nano and Tiny, and of the larger ones. A file without
fixed shapes is run at both: the larger size finds small objects."""
PAD_VALUE = 114
GEOMETRY = 5
"""x, y, width, height and objectness come before the class probabilities."""


@dataclass(frozen=True)
class YoloxConfig:
    """Which boxes are kept.

    Attributes:
        min_score: class probability times objectness below which a box is dropped.
        nms_iou: overlap above which the worse of two boxes of a class is removed.
        vote_iou: overlap above which boxes of a class, removed ones included, are averaged into the
            one that is kept.
        max_count: largest number of boxes.
        mirror: detect in the mirror image as well, for twice the time.
        sizes_px: sides of the square input; the network runs at each that the file accepts, and all
            boxes count.
    """

    min_score: float = 0.001
    nms_iou: float = 0.65
    vote_iou: float = 0.8
    max_count: int = 100
    mirror: bool = True
    sizes_px: tuple[int, ...] = SIZES_PX


class YoloxDetector:
    """A COCO detector whose classes are matched to a label set by name.

    Raises:
        InputError: no such file, or a network of another kind.
    """

    def __init__(self, path: Path, config: YoloxConfig | None = None) -> None:
        if not path.is_file():
            raise InputError(f"{path}: no such file; give a YOLOX network in ONNX")
        try:
            self._network = cv2.dnn.readNetFromONNX(str(path))
        except cv2.error as error:
            raise InputError(f"{path}: OpenCV cannot read it as ONNX; export it again") from error
        self._path = path
        self._config = config or YoloxConfig()
        self._classes = read_label_set("coco")
        self._sides_px = self._find_sides()

    def detect(self, image: Image, labels: LabelSet) -> ClassifiedBoxes:
        """Boxes in an image (H, W, 3), red first, of the classes in ``labels``."""
        passes = [self._run(image, side) for side in self._sides_px]
        if self._config.mirror:
            other = np.ascontiguousarray(image[:, ::-1])
            mirrored = [self._run(other, side) for side in self._sides_px]
            for boxes, _ in mirrored:
                boxes[:, [2, 0]] = image.shape[1] - boxes[:, [0, 2]]
            passes += mirrored
        every, probabilities = (np.concatenate(part) for part in zip(*passes, strict=True))
        numbers = np.array([labels.number(name) for name in self._classes.names[1:]])
        return self._select(every, probabilities, numbers, len(labels))

    def _run(self, image: Image, side_px: int) -> tuple[NDArray, NDArray]:
        """All boxes (P, 4) in the image's pixels, and class probabilities (P, 80)."""
        blob, factor = letterbox(image, side_px)
        self._network.setInput(blob)
        boxes, probabilities = decode(self._network.forward()[0], side_px)
        height, width = image.shape[:2]
        return np.clip(boxes / factor, 0, [width, height, width, height]), probabilities

    def _select(
        self, boxes: NDArray, probabilities: NDArray, numbers: NDArray, classes: int
    ) -> ClassifiedBoxes:
        """The best boxes (N, 4) after suppression, from (P, 4) and (P, 80)."""
        known = np.flatnonzero(numbers > 0)
        distribution = np.zeros((len(boxes), classes), np.float32)
        distribution[:, numbers[known]] = probabilities[:, known]
        label, score = distribution.argmax(axis=1), distribution.max(axis=1)
        sizes = boxes[:, 2:] - boxes[:, :2]
        chosen = np.flatnonzero((score > self._config.min_score) & (sizes > 1).all(axis=1))
        distribution = distribution[chosen]
        total = distribution.sum(axis=1, keepdims=True)
        distribution /= np.maximum(total, 1)
        distribution[:, 0] = 1 - distribution.sum(axis=1)
        box_tensor = torch.from_numpy(boxes[chosen].astype(np.float32))
        score_tensor = torch.from_numpy(score[chosen])
        label_tensor = torch.from_numpy(label[chosen])
        keep = grouped_nms(box_tensor, score_tensor, label_tensor, self._config.nms_iou)
        keep = keep[: self._config.max_count]
        best = voted(box_tensor, score_tensor, label_tensor, keep, self._config.vote_iou)
        return ClassifiedBoxes(
            best, label_tensor[keep], score_tensor[keep],
            torch.from_numpy(distribution)[keep],
        )  # fmt: skip

    def _find_sides(self) -> tuple[int, ...]:
        """The accepted input sizes, found by trial: OpenCV does not show a file's shapes."""
        sides = tuple(side for side in self._config.sizes_px if self._accepts(side))
        if not sides:
            raise InputError(
                f"{self._path}: not a YOLOX network for COCO's 80 classes at one of "
                f"{self._config.sizes_px} pixels; give one of these"
            )
        return sides

    def _accepts(self, side_px: int) -> bool:
        """Whether an input of this size gives an output of YOLOX's shape."""
        self._network.setInput(np.zeros((1, 3, side_px, side_px), np.float32))
        try:
            output = self._network.forward()
        except cv2.error:
            return False
        cells = sum((side_px // stride) ** 2 for stride in STRIDES)
        return bool(output.shape == (1, cells, GEOMETRY + len(self._classes) - 1))


def voted(boxes: Tensor, scores: Tensor, labels: Tensor, keep: Tensor, min_iou: float) -> Tensor:
    """The kept boxes (K, 4), each the mean of the boxes of its class with at least ``min_iou``.

    Weights are the scores (Gidaris and Komodakis 2015, section 4).
    """
    alike = (labels[keep, None] == labels) & (iou(boxes[keep], boxes) >= min_iou)
    weights = alike * scores
    return (weights @ boxes) / weights.sum(dim=1, keepdim=True)


def letterbox(image: Image, side_px: int) -> tuple[Floats, float]:
    """The network's input (1, 3, side, side), blue first in 0..255, and the factor of its scale.

    The image is at the upper left; the rest is grey.
    """
    height, width = image.shape[:2]
    factor = min(side_px / height, side_px / width)
    size = (max(int(width * factor), 1), max(int(height * factor), 1))
    resized = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    padded = np.full((side_px, side_px, 3), PAD_VALUE, np.uint8)
    padded[: size[1], : size[0]] = resized
    blob = padded[:, :, ::-1].transpose(2, 0, 1)[None].astype(np.float32)
    return np.ascontiguousarray(blob), factor


def decode(output: NDArray, side_px: int) -> tuple[NDArray, NDArray]:
    """Boxes (P, 4) in pixels of the input, and class probabilities (P, 80) times objectness.

    Row (x, y, w, h, o, c...) of a cell (column, row) of stride s: centre (x + column, y + row) s,
    size (exp(w), exp(h)) s; rows in the order of the strides, then of rows and columns.
    """
    cells, strides = [], []
    for stride in STRIDES:
        n = side_px // stride
        grid = np.stack(np.meshgrid(np.arange(n), np.arange(n)), axis=-1).reshape(-1, 2)
        cells.append(grid)
        strides.append(np.full((n * n, 1), stride))
    cell, step = np.concatenate(cells), np.concatenate(strides)
    centre = (output[:, :2] + cell) * step
    half = 0.5 * np.exp(output[:, 2:4]) * step
    boxes = np.concatenate([centre - half, centre + half], axis=1)
    return boxes, output[:, GEOMETRY - 1 : GEOMETRY] * output[:, GEOMETRY:]
