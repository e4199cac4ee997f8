"""The losses of the paper's eq. (10), corrected, and a dice loss of the masks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.semantics.network import boxes as box_ops
from bmask_slam.semantics.network import mask_heads
from bmask_slam.semantics.network.anchors import make_anchors
from bmask_slam.semantics.network.images import ImageBatch, prepare
from bmask_slam.semantics.network.mask_heads import of_class
from bmask_slam.semantics.network.model import ROI_LEVELS, MaskRCNN
from bmask_slam.semantics.network.roi_align import FeatureTable, feature_table, roi_align
from bmask_slam.semantics.network.rpn import select_proposals
from bmask_slam.semantics.training.targets import (
    BOX_RULE,
    RPN_RULE,
    Target,
    draw_evenly,
    draw_samples,
    iou_targets,
    mask_targets,
    match,
)

SMOOTH_L1_BETA = 1 / 9
PROPOSALS_FACTOR = 2
"""Factor on the number of proposals in training."""
JITTERS = 3
"""Number of boxes drawn around each object, if masks are trained there."""
JITTER_SHARE = 0.25
"""Largest displacement of their corners, relative to the box's size. Each box draws its own from 0
to this, since the MaskIoU head needs examples of good and of bad masks."""
MAX_ROIS = 64
"""Largest number of these boxes in an image."""

Losses = dict[str, Tensor]
MaskRois = Literal["proposals", "objects"]
Only = Literal["", "boxes", "masks", "maskiou"]


@dataclass(frozen=True)
class Rois:
    """Positive boxes of a batch, for the mask heads.

    Attributes:
        boxes: (R_b, 4) of each image, in pixels of the batch.
        owners: (R_b,) the object of each box.
    """

    boxes: list[Tensor]
    owners: list[Tensor]


def network_losses(
    model: MaskRCNN,
    images: Sequence[Tensor],
    targets: Sequence[Target],
    generator: torch.Generator,
    rois: MaskRois = "proposals",
    only: Only = "",
) -> Losses:
    """All losses of a batch; training minimises their sum.

    Args:
        rois: where masks are trained: in the RPN's proposals, or in boxes around the objects.
        only: "boxes": the losses of the RPN and the box head; "masks" or "maskiou": those of the
            other heads, for boxes from another detector; "": all.
    """
    batch = prepare(images, model.config.image)
    scaled = [
        box_ops.rescale(t.boxes, old, new)
        for t, old, new in zip(targets, batch.original_sizes, batch.sizes, strict=True)
    ]
    levels = model.backbone(batch.tensor)
    table = feature_table(levels[:ROI_LEVELS], batch.size[0])
    losses: Losses = {}
    found = around_objects(scaled, targets, batch, generator)
    if only in ("", "boxes") or rois == "proposals":
        rpn, proposals = rpn_losses(model, levels, batch, scaled, targets, generator)
        box, positives = box_losses(model, table, proposals, scaled, targets, generator)
        found = positives if rois == "proposals" else found
        losses |= rpn | box
    if only != "boxes":
        losses |= mask_losses(model, table, found, targets, batch)
    return losses


def rpn_losses(
    model: MaskRCNN,
    levels: Sequence[Tensor],
    batch: ImageBatch,
    objects: Sequence[Tensor],
    targets: Sequence[Target],
    generator: torch.Generator,
) -> tuple[Losses, list[Tensor]]:
    """Losses of objectness and anchor offsets over sampled anchors; and the proposals."""
    logits, offsets = model.rpn.head(levels)
    anchors = make_anchors(levels, batch.size, model.config.anchors)
    every, all_logits, all_offsets = torch.cat(anchors), torch.cat(logits, 1), torch.cat(offsets, 1)
    scored, moved, target_masks, truth = [], [], [], []
    for b, (boxes, target) in enumerate(zip(objects, targets, strict=True)):
        matched = match(every, boxes, RPN_RULE)
        positive, negative = draw_samples(matched, target.labels, RPN_RULE, generator)
        scored.append(all_logits[b, torch.cat([positive, negative])])
        truth.append(torch.cat([torch.ones(len(positive)), torch.zeros(len(negative))]))
        moved.append(all_offsets[b, positive])
        target_masks.append(
            box_ops.encode(boxes[matched[positive]], every[positive].float(), box_ops.RPN_WEIGHTS)
        )
    scores = torch.cat(scored).float()
    objectness = F.binary_cross_entropy_with_logits(scores, torch.cat(truth).to(scores))
    box = _smooth_l1(torch.cat(moved), torch.cat(target_masks), len(scores))
    usual = model.config.proposals
    more = replace(usual, after_nms=PROPOSALS_FACTOR * usual.after_nms)
    proposals = select_proposals(anchors, logits, offsets, batch.sizes, more)
    return {"objectness": objectness, "rpn_box": box}, proposals


def box_losses(
    model: MaskRCNN,
    table: FeatureTable,
    proposals: Sequence[Tensor],
    objects: Sequence[Tensor],
    targets: Sequence[Target],
    generator: torch.Generator,
) -> tuple[Losses, Rois]:
    """Losses of class and box over sampled proposals and the objects' own boxes."""
    chosen, labels, target_masks, positives = [], [], [], Rois([], [])
    for found, boxes, target in zip(proposals, objects, targets, strict=True):
        candidates = torch.cat([found, boxes])
        matched = match(candidates, boxes, BOX_RULE)
        positive, negative = draw_samples(matched, target.labels, BOX_RULE, generator)
        owner = matched[positive]
        chosen.append(candidates[torch.cat([positive, negative])])
        labels.append(torch.cat([target.labels[owner], torch.zeros_like(negative)]))
        offsets = box_ops.encode(boxes[owner], candidates[positive], box_ops.BOX_WEIGHTS)
        target_masks.append(torch.cat([offsets, offsets.new_zeros(len(negative), 4)]))
        positives.boxes.append(candidates[positive])
        positives.owners.append(owner)
    logits, predicted = model.roi_heads.boxes(table, chosen)
    label, offset = torch.cat(labels), torch.cat(target_masks)
    is_object = label > 0
    box = _smooth_l1(of_class(predicted, label)[is_object], offset[is_object], len(label))
    return {"class": F.cross_entropy(logits.float(), label), "box": box}, positives


def around_objects(
    objects: Sequence[Tensor],
    targets: Sequence[Target],
    batch: ImageBatch,
    generator: torch.Generator,
) -> Rois:
    """Random boxes near each object, similar to those of an imperfect detector."""
    found = Rois([], [])
    for boxes, target, size in zip(objects, targets, batch.sizes, strict=True):
        owner = torch.arange(len(boxes), device=boxes.device).repeat(JITTERS)
        owner = owner[draw_evenly(target.labels[owner], MAX_ROIS, generator)]
        near = boxes[owner]
        noise = torch.rand(near.shape, generator=generator).to(near) * 2 - 1
        noise *= torch.rand((len(near), 1), generator=generator).to(near)
        sides = (near[:, 2:] - near[:, :2]).repeat(1, 2)
        moved = box_ops.clip(near + noise * JITTER_SHARE * sides, size)
        kept = box_ops.at_least(moved, 1.0)
        found.boxes.append(moved[kept])
        found.owners.append(owner[kept])
    return found


def mask_losses(
    model: MaskRCNN, table: FeatureTable, found: Rois, targets: Sequence[Target], batch: ImageBatch
) -> Losses:
    """Losses of the masks and of the predicted IoUs, of each object's class (eq. 11)."""
    heads = model.roi_heads
    context = model.config.mask_context
    found = Rois([box_ops.enlarged(b, context) for b in found.boxes], found.owners)
    if sum(len(o) for o in found.owners) == 0:
        nothing = table.rows.sum() * 0
        names = ["mask", "dice", *(["maskiou"] if heads.maskiou_head else [])]
        return dict.fromkeys(names, nothing)
    features = roi_align(table, found.boxes, mask_heads.BINS)
    every = heads.mask_predictor(heads.mask_head(features))
    labels = torch.cat([t.labels[o] for t, o in zip(targets, found.owners, strict=True)])
    logits = of_class(every, labels).float()
    target, object_px, box_px = _target_masks(found, targets, batch, logits.shape[-1])
    masks = logits.sigmoid()
    losses = {
        "mask": F.binary_cross_entropy_with_logits(logits, target.to(logits)),
        "dice": dice_loss(masks, target.to(masks)),
    }
    if heads.maskiou_head is not None:
        masks = masks.detach()
        ious = of_class(heads.maskiou_head(features, masks), labels).float()
        truth = iou_targets(masks, target, object_px, box_px).to(ious)
        losses["maskiou"] = 0.5 * F.mse_loss(ious, truth)
    return losses


def dice_loss(masks: Tensor, target: Tensor) -> Tensor:
    """Mean of 1 - 2 |A B| / (|A|^2 + |B|^2) over masks (R, M, M) in 0..1 (Milletari et al. 2016).

    It is relative to the mask's area, so that thin structures (leaves, legs, shelves) count, which
    the mean over cells neglects.
    """
    both = (masks * target).sum(dim=(1, 2))
    areas = masks.square().sum(dim=(1, 2)) + target.square().sum(dim=(1, 2))
    return (1 - (2 * both + 1) / (areas + 1)).mean()


def _target_masks(
    found: Rois, targets: Sequence[Target], batch: ImageBatch, bins: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Mask targets (R, bins, bins), areas (R,) of objects and of boxes in original pixels."""
    target_masks, object_px, box_px = [], [], []
    for b, (boxes, owner, target) in enumerate(
        zip(found.boxes, found.owners, targets, strict=True)
    ):
        own = box_ops.rescale(boxes, batch.sizes[b], batch.original_sizes[b])
        target_masks.append(mask_targets(target.masks, owner, own, bins))
        object_px.append(target.masks.sum(dim=(1, 2))[owner].float())
        box_px.append(box_ops.area(own))
    return torch.cat(target_masks), torch.cat(object_px), torch.cat(box_px)


def _smooth_l1(found: Tensor, target: Tensor, count: int) -> Tensor:
    """Sum over the boxes' offsets, divided by the number of all sampled boxes."""
    total = F.smooth_l1_loss(found.float(), target.float(), beta=SMOOTH_L1_BETA, reduction="sum")
    return total / max(count, 1)
