"""The losses of the heads on YOLOX-Nano's features; the detector itself is not trained."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from bmask_slam.semantics.labels import read_label_set
from bmask_slam.semantics.network import boxes as box_ops
from bmask_slam.semantics.network.images import ImageBatch
from bmask_slam.semantics.network.yolox.mask_scoring import MaskScoringYolox, around
from bmask_slam.semantics.network.yolox.network import Features, decode
from bmask_slam.semantics.network.yolox.selection import SelectionConfig, select
from bmask_slam.semantics.training.losses import Losses, Rois, around_objects, dice_loss
from bmask_slam.semantics.training.targets import Target, iou_targets, mask_targets

DETECTED = SelectionConfig(min_score=0.05, nms_iou=0.65)
MATCH_IOU = 0.4
"""A detected box is an example if it overlaps an object of its class by this."""


def yolox_losses(
    model: MaskScoringYolox,
    images: Sequence[Tensor],
    targets: Sequence[Target],
    generator: torch.Generator,
) -> Losses:
    """Losses of masks (cross-entropy and dice) and of predicted IoUs, means over the images' RoIs.

    Args:
        images: (3, H, W) each, in 0..1.
        targets: objects in their pixels, with COCO's labels.
    """
    parts = [_image_losses(model, *given, generator) for given in zip(images, targets, strict=True)]
    return {name: torch.stack([p[name] for p in parts]).mean() for name in parts[0]}


def _image_losses(
    model: MaskScoringYolox, image: Tensor, target: Target, generator: torch.Generator
) -> Losses:
    """The losses of one image (3, H, W)."""
    tensor, factor = model.detector.letterboxed(image * 255)
    objects = Target(target.boxes * factor, target.labels, target.masks)
    with torch.no_grad():
        features = model.detector.features(tensor)
        boxes, owners = _rois(model, features, tensor, objects, generator)
    if len(owners) == 0:
        nothing = model.narrowed.weight.sum() * 0
        return dict.fromkeys(("mask", "dice", "maskiou"), nothing)
    logits, ious = model.masks(features, [boxes])
    own = around(boxes) / factor
    wanted = mask_targets(target.masks, owners, own, logits.shape[-1])
    logits, masks = logits.float(), logits.float().sigmoid()
    object_px = target.masks.sum(dim=(1, 2))[owners].float()
    truth = iou_targets(masks.detach(), wanted, object_px, box_ops.area(own))
    return {
        "mask": F.binary_cross_entropy_with_logits(logits, wanted),
        "dice": dice_loss(masks, wanted),
        "maskiou": 0.5 * F.mse_loss(ious.float(), truth),
    }


def _rois(
    model: MaskScoringYolox,
    features: Features,
    tensor: Tensor,
    objects: Target,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Boxes (R, 4) near objects, drawn and detected, and the object (R,) of each."""
    size = (tensor.shape[2], tensor.shape[3])
    batch = ImageBatch(tensor, [size], [size])
    drawn: Rois = around_objects([objects.boxes], [objects], batch, generator)
    found = decode(model.detector.detections(features)[0].float(), size)
    detected = select(*found, size, read_label_set("coco"), DETECTED)
    same = detected.labels[:, None] == objects.labels
    overlap, owner = (box_ops.iou(detected.boxes, objects.boxes) * same).max(dim=1)
    near = overlap >= MATCH_IOU
    boxes = torch.cat([drawn.boxes[0], detected.boxes[near]])
    return boxes, torch.cat([drawn.owners[0], owner[near]])
