"""The box head: class of each proposal, and a corrected box for each class."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.semantics.network import boxes as box_ops
from bmask_slam.semantics.network.backbone.layers import NormKind, conv_stack
from bmask_slam.semantics.network.config import DetectionConfig, NetworkConfig
from bmask_slam.semantics.network.nms import grouped_nms

BINS = 7
MIN_SIZE_PX = 1e-2


class TwoHiddenLayers(nn.Module):
    """The box head of torchvision's v1: two fully connected layers."""

    def __init__(self, inputs: int, hidden: int) -> None:
        super().__init__()
        self.fc6 = nn.Linear(inputs, hidden)
        self.fc7 = nn.Linear(hidden, hidden)

    def forward(self, x: Tensor) -> Tensor:
        """(R, C, 7, 7) to (R, hidden)."""
        return F.relu_(self.fc7(F.relu_(self.fc6(x.flatten(1)))))


def make_box_head(config: NetworkConfig) -> nn.Module:
    """(R, C, 7, 7) to (R, hidden): two hidden layers, or convolutions and one."""
    cells = BINS * BINS
    if config.box_convs == 0:
        return TwoHiddenLayers(config.channels * cells, config.box_hidden)
    norm: NormKind = "batch" if config.norm == "batch" else "none"
    convs = conv_stack(config.channels, config.channels, config.box_convs, norm)
    last = nn.Linear(config.channels * cells, config.box_hidden)
    return nn.Sequential(*convs, nn.Flatten(), last, nn.ReLU(inplace=True))


class BoxPredictor(nn.Module):
    """Class logits and box offsets of each class."""

    def __init__(self, hidden: int, classes: int) -> None:
        super().__init__()
        self.cls_score = nn.Linear(hidden, classes)
        self.bbox_pred = nn.Linear(hidden, 4 * classes)

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(R, hidden) to logits (R, classes) and offsets (R, classes, 4)."""
        return self.cls_score(x), self.bbox_pred(x).unflatten(1, (-1, 4))


@dataclass(frozen=True)
class ClassifiedBoxes:
    """Detections of one image, best first.

    Attributes:
        boxes: (N, 4) in pixels of their image.
        labels: (N,) int64, 1..classes-1.
        scores: (N,) probability of the label.
        distributions: (N, classes) probabilities, background first; they sum to 1.
    """

    boxes: Tensor
    labels: Tensor
    scores: Tensor
    distributions: Tensor

    def to(self, device: str) -> ClassifiedBoxes:
        """A copy on a device."""
        return ClassifiedBoxes(*(getattr(self, f.name).to(device) for f in fields(self)))


def classify(
    logits: Tensor,
    offsets: Tensor,
    proposals: Tensor,
    size: tuple[int, int],
    config: DetectionConfig,
) -> ClassifiedBoxes:
    """Detections from the head's outputs (R, classes), (R, classes, 4) for one image's proposals.

    Every class of a proposal is a candidate with its own box; candidates of one class suppress
    each other.
    """
    distribution = logits.softmax(dim=1)
    candidates = box_ops.clip(box_ops.decode(offsets, proposals, box_ops.BOX_WEIGHTS), size)
    row, column = torch.nonzero(distribution[:, 1:] > config.min_score, as_tuple=True)
    label = column + 1
    boxes, scores = candidates[row, label], distribution[row, label]
    large = box_ops.at_least(boxes, MIN_SIZE_PX)
    row, label, boxes, scores = row[large], label[large], boxes[large], scores[large]
    keep = grouped_nms(boxes, scores, label, config.nms_iou)[: config.max_count]
    return ClassifiedBoxes(boxes[keep], label[keep], scores[keep], distribution[row[keep]])
