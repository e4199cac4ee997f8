"""Boxes from a YOLOX detector (Ge et al. 2021) in an ONNX file, run by OpenCV."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.arrays import Floats, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import clip, mirrored
from bmask_slam.semantics.network.yolox.network import (
    CLASSES,
    GEOMETRY,
    PAD_VALUE,
    STRIDES,
    decode,
)
from bmask_slam.semantics.network.yolox.selection import SelectionConfig, select

SIZES_PX = (416, 640)
"""Input sizes of the published networks: of Nano and Tiny, and of the larger ones. A file without
fixed shapes is run at both: the larger size finds small objects."""


@dataclass(frozen=True)
class YoloxConfig:
    """How the network is run.

    Attributes:
        selection: which boxes are kept.
        mirror: detect in the mirror image as well, for twice the time.
        sizes_px: sides of the square input; the network runs at each that the file accepts, and all
            boxes count.
    """

    selection: SelectionConfig = field(default_factory=SelectionConfig)
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
        self._sides_px = self._find_sides()

    def detect(self, image: Image, labels: LabelSet) -> ClassifiedBoxes:
        """Boxes in an image (H, W, 3), red first, of the classes in ``labels``."""
        passes = [self._run(image, side) for side in self._sides_px]
        if self._config.mirror:
            other = np.ascontiguousarray(image[:, ::-1])
            others = [self._run(other, side) for side in self._sides_px]
            passes += [(mirrored(boxes, image.shape[1]), found) for boxes, found in others]
        every, probabilities = (torch.cat(part) for part in zip(*passes, strict=True))
        size = (image.shape[0], image.shape[1])
        return select(every, probabilities, size, labels, self._config.selection)

    def _run(self, image: Image, side_px: int) -> tuple[Tensor, Tensor]:
        """All boxes (P, 4) in the image's pixels, and class probabilities (P, 80)."""
        blob, factor = letterbox(image, side_px)
        self._network.setInput(blob)
        output = torch.from_numpy(self._network.forward()[0])
        boxes, probabilities = decode(output, (side_px, side_px))
        return clip(boxes / factor, (image.shape[0], image.shape[1])), probabilities

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
        return bool(output.shape == (1, cells, GEOMETRY + CLASSES))


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
