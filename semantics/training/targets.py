"""Targets of training: matching of boxes to objects, sampling of boxes, masks and IoUs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.semantics.network.boxes import iou

IGNORED = -2
NOTHING = -1


@dataclass(frozen=True)
class Target:
    """The objects of one training image, in its own pixels.

    Attributes:
        boxes: (G, 4) x1, y1, x2, y2.
        labels: (G,) int64, from 1.
        masks: (G, H, W) bool.
    """

    boxes: Tensor
    labels: Tensor
    masks: Tensor


@dataclass(frozen=True)
class MatchRule:
    """How boxes are matched to objects, and how many are drawn (Ren et al. 2015).

    Attributes:
        positive_iou: overlap from which a box is matched to an object.
        negative_iou: overlap below which it is background; in between it is ignored.
        rescue: whether an object's best box is matched to it however small the overlap.
        count: number of boxes drawn from an image.
        positive_share: largest share of positive boxes among them.
    """

    positive_iou: float
    negative_iou: float
    rescue: bool
    count: int
    positive_share: float


RPN_RULE = MatchRule(0.7, 0.3, rescue=True, count=256, positive_share=0.5)
BOX_RULE = MatchRule(0.5, 0.5, rescue=False, count=512, positive_share=0.25)


def match(boxes: Tensor, objects: Tensor, rule: MatchRule) -> Tensor:
    """The object (N,) of each box (N, 4), or NOTHING, or IGNORED; objects are (G, 4)."""
    if len(objects) == 0:
        return torch.full((len(boxes),), NOTHING, device=boxes.device)
    overlap = iou(objects, boxes)
    best, matched = overlap.max(dim=0)
    found = matched.clone()
    found[best < rule.positive_iou] = IGNORED
    found[best < rule.negative_iou] = NOTHING
    if rule.rescue:
        highest = overlap.max(dim=1, keepdim=True).values
        rescued = ((overlap == highest) & (highest > 0)).any(dim=0)
        found[rescued] = matched[rescued]
    return found


def draw_samples(
    matched: Tensor, labels: Tensor, rule: MatchRule, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Indices of positive and of negative boxes, drawn at random from matches (N,).

    ``labels`` (G,) are the objects' classes, which are equally likely among the positives.
    """
    positive, negative = torch.nonzero(matched >= 0)[:, 0], torch.nonzero(matched == NOTHING)[:, 0]
    count = min(int(rule.count * rule.positive_share), len(positive))
    chosen = torch.randperm(len(negative), generator=generator)[: rule.count - count]
    return (
        positive[draw_evenly(labels[matched[positive]], count, generator)],
        negative[chosen.to(negative.device)],
    )


def draw_evenly(labels: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Up to ``count`` random indices into ``labels`` (N,), balanced over the labels.

    If all objects were equally likely, the hundred books of a shelf would crowd out the chair in
    front of it.
    """
    order = torch.randperm(len(labels), generator=generator).to(labels.device)
    by_label, place = labels[order].sort(stable=True)
    turn = torch.arange(len(labels), device=labels.device) - torch.searchsorted(by_label, by_label)
    return order[place[turn.argsort(stable=True)[:count]]]


def mask_targets(masks: Tensor, owner: Tensor, boxes: Tensor, bins: int) -> Tensor:
    """Share (R, bins, bins) of each bin of the boxes (R, 4) that the masks (G, H, W) cover.

    ``owner`` (R,) is the mask of each box. The sum of a mask over a rectangle follows from its
    integral image at the corners, which is bilinear between pixels, so that the share is exact.
    """
    integral = F.pad(masks.float().cumsum(1).cumsum(2), (1, 0, 1, 0))
    steps = torch.linspace(0, 1, bins + 1, device=boxes.device)
    x = boxes[:, :1] + (boxes[:, 2:3] - boxes[:, :1]) * steps
    y = boxes[:, 1:2] + (boxes[:, 3:] - boxes[:, 1:2]) * steps
    corners = _bilinear(integral, owner, x, y)
    sums = corners[:, 1:, 1:] - corners[:, :-1, 1:] - corners[:, 1:, :-1] + corners[:, :-1, :-1]
    size = ((boxes[:, 2:] - boxes[:, :2]) / bins).clamp(min=1e-6)
    return (sums / size.prod(dim=1)[:, None, None]).clamp(0, 1)


def _bilinear(images: Tensor, which: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Values (R, K, K) of images (G, H, W) at all pairs of rows y (R, K) and columns x (R, K)."""
    height, width = images.shape[1:]
    x, y = x.clamp(0, width - 1), y.clamp(0, height - 1)
    left, top = x.floor().long().clamp(max=width - 2), y.floor().long().clamp(max=height - 2)
    fx, fy = (x - left)[:, None, :], (y - top)[:, :, None]
    image, row, column = which[:, None, None], top[:, :, None], left[:, None, :]
    upper = images[image, row, column] * (1 - fx) + images[image, row, column + 1] * fx
    lower = images[image, row + 1, column] * (1 - fx) + images[image, row + 1, column + 1] * fx
    return upper * (1 - fy) + lower * fy


def iou_targets(predicted: Tensor, target: Tensor, object_px: Tensor, box_px: Tensor) -> Tensor:
    """IoU (R,) of predicted masks with the WHOLE objects (Huang et al. 2019, section 3.2).

    Args:
        predicted: (R, M, M) probabilities, binarised at 0.5.
        wanted: (R, M, M) shares of the object inside the box.
        object_px: (R,) area of the whole object, also outside the box.
        box_px: (R,) area of the box, from which that of a cell follows.
    """
    mask, inside = (predicted > 0.5).float(), (target > 0.5).float()
    cell_px = box_px / predicted.shape[1] ** 2
    intersection = (mask * inside).sum(dim=(1, 2)) * cell_px
    union = mask.sum(dim=(1, 2)) * cell_px + object_px - intersection
    return (intersection / union.clamp(min=1e-6)).clamp(0, 1)
