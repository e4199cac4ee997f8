"""Which boxes of a YOLOX detector are kept."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import at_least, clip, iou
from bmask_slam.semantics.network.nms import grouped_nms

MIN_SIZE_PX = 1.0


@dataclass(frozen=True)
class SelectionConfig:
    """Which boxes are kept.

    Attributes:
        min_score: class probability times objectness below which a box is dropped.
        nms_iou: overlap above which the worse of two boxes of a class is removed.
        vote_iou: overlap above which boxes of a class, removed ones included, are averaged into the
            one that is kept.
        max_count: largest number of boxes.
    """

    min_score: float = 0.001
    nms_iou: float = 0.5
    vote_iou: float = 0.8
    max_count: int = 100


def select(
    boxes: Tensor,
    probabilities: Tensor,
    size: tuple[int, int],
    labels: LabelSet,
    config: SelectionConfig,
) -> ClassifiedBoxes:
    """The best boxes after suppression, best first.

    Args:
        boxes: (P, 4) in pixels of an image of (height, width) ``size``.
        probabilities: (P, 80) of COCO's classes.
        labels: set that these are looked up in by name; boxes of other classes are dropped.
        config: limits.
    """
    numbers = torch.tensor([labels.number(name) for name in _classes()], device=boxes.device)
    score, label = (probabilities * (numbers > 0)).max(dim=1)
    boxes = clip(boxes, size)
    chosen = (score > config.min_score) & at_least(boxes, MIN_SIZE_PX)
    boxes, score, label = boxes[chosen], score[chosen], numbers[label[chosen]]
    keep = grouped_nms(boxes, score, label, config.nms_iou)[: config.max_count]
    best = voted(boxes, score, label, keep, config.vote_iou)
    distribution = _distributions(probabilities[chosen][keep], numbers, len(labels))
    return ClassifiedBoxes(best, label[keep], score[keep], distribution)


@cache
def _classes() -> tuple[str, ...]:
    return read_label_set("coco").names[1:]


def _distributions(probabilities: Tensor, numbers: Tensor, classes: int) -> Tensor:
    """(N, classes) from (N, 80) with labels (80,); the rest to 1 goes to the background."""
    known = torch.nonzero(numbers)[:, 0]
    found = probabilities.new_zeros(len(probabilities), classes)
    found[:, numbers[known]] = probabilities[:, known]
    found /= found.sum(dim=1, keepdim=True).clamp(min=1)
    found[:, 0] = (1 - found.sum(dim=1)).clamp(min=0)  # not below by rounding
    return found


def voted(boxes: Tensor, scores: Tensor, labels: Tensor, keep: Tensor, min_iou: float) -> Tensor:
    """The kept boxes (K, 4), each the mean of the boxes of its class with at least ``min_iou``.

    Weights are the scores (Gidaris and Komodakis 2015, section 4).
    """
    alike = (labels[keep, None] == labels) & (iou(boxes[keep], boxes) >= min_iou)
    weights = alike * scores
    return (weights @ boxes) / weights.sum(dim=1, keepdim=True)
