"""Targets and losses of training against simple versions, and a small overfit."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, cast

import numpy as np
import pytest
import torch
from repository import shared

from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.config import DetectionConfig, ImageConfig, NetworkConfig
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.segmenters.network_segmenter import paste
from bmask_slam.semantics.training.losses import Only, dice_loss, network_losses
from bmask_slam.semantics.training.targets import (
    BOX_RULE,
    IGNORED,
    NOTHING,
    RPN_RULE,
    Target,
    draw_evenly,
    draw_samples,
    iou_targets,
    mask_targets,
    match,
)
from bmask_slam.semantics.weights.checkpoints import load_mobilenet

TINY = NetworkConfig(
    classes=3, backbone="mobilenet_v2", norm="none", channels=24, box_hidden=32, mask_channels=16,
    maskiou_channels=16, maskiou_hidden=32, image=ImageConfig(96, 128),
    detections=DetectionConfig(min_score=0.3, max_count=10),
)  # fmt: skip


def test_matching_keeps_the_best_box_of_each_object() -> None:
    objects = torch.tensor([[0.0, 0.0, 10.0, 10.0], [50.0, 50.0, 60.0, 60.0]])
    boxes = torch.tensor([
        [0.0, 0.0, 10.0, 9.0],  # IoU 0.9 with the first
        [0.0, 0.0, 10.0, 5.0],  # 0.5
        [20.0, 20.0, 30.0, 30.0],  # none
        [50.0, 50.0, 60.0, 52.0],  # 0.2, but the second's best
    ])  # fmt: skip
    assert match(boxes, objects, RPN_RULE).tolist() == [0, IGNORED, NOTHING, 1]
    assert match(boxes, objects, BOX_RULE).tolist() == [0, 0, NOTHING, NOTHING]
    assert match(boxes, objects[:0], RPN_RULE).tolist() == [NOTHING] * 4


def test_samples_keep_the_share_of_positives_and_fill_up_with_negatives() -> None:
    matched = torch.cat([torch.zeros(300), torch.full((900,), NOTHING)]).long()
    rule = replace(BOX_RULE, count=100)
    one = torch.tensor([3])
    positive, negative = draw_samples(matched, one, rule, torch.Generator().manual_seed(0))
    assert (len(positive), len(negative)) == (25, 75)
    assert (matched[positive] == 0).all()
    assert (matched[negative] == NOTHING).all()
    assert len(positive.unique()) == 25
    few, rest = draw_samples(matched[295:], one, rule, torch.Generator().manual_seed(0))
    assert (len(few), len(rest)) == (5, 95)


def test_classes_have_equal_chances_however_many_objects_they_have() -> None:
    labels = torch.tensor([7] * 100 + [2] * 4 + [5] * 40)
    drawn = draw_evenly(labels, 24, torch.Generator().manual_seed(0))
    assert len(drawn.unique()) == 24
    assert labels[drawn].bincount()[[2, 5, 7]].tolist() == [4, 10, 10]
    again = draw_evenly(labels, 24, torch.Generator().manual_seed(1))
    assert set(again.tolist()) != set(drawn.tolist())
    everything = draw_evenly(labels, 500, torch.Generator().manual_seed(0))
    assert sorted(everything.tolist()) == list(range(144))


def test_dice_counts_the_share_of_a_mask_that_is_right() -> None:
    target = torch.zeros(2, 28, 28)
    target[0, 4:24, 3] = 1  # thin
    target[1, 4:24, 4:24] = 1
    assert float(dice_loss(target, target)) == pytest.approx(0, abs=1e-6)
    half = target.clone()
    half[0, 14:] = 0
    thin = float(dice_loss(half[:1], target[:1]))
    assert thin == pytest.approx(1 - 21 / 31)
    wide = target[1:].clone()
    wide[0, 14:] = 0
    assert float(dice_loss(wide, target[1:])) == pytest.approx(thin, abs=0.02)


def test_mask_targets_are_exact_shares() -> None:
    rng = np.random.default_rng(0)
    masks = torch.from_numpy(rng.uniform(size=(2, 12, 16)) > 0.5)
    boxes = torch.tensor([[1.5, 2.25, 9.5, 10.25], [0.0, 0.0, 16.0, 12.0]])
    found = mask_targets(masks, torch.tensor([1, 0]), boxes, 4)
    fine = masks.float().repeat_interleave(40, 1).repeat_interleave(40, 2)  # 1/40 px
    for k, (owner, box) in enumerate(zip((1, 0), boxes, strict=True)):
        x1, y1, x2, y2 = (round(float(v) * 40) for v in box)
        crop = fine[owner, y1:y2, x1:x2]
        blocks = crop.unflatten(0, (4, -1))[:, : crop.shape[0] // 4]
        expected = torch.stack([
            torch.stack([part.mean() for part in row.tensor_split(4, dim=1)]) for row in blocks
        ])  # fmt: skip
        torch.testing.assert_close(found[k], expected, atol=2e-3, rtol=0)


def test_the_iou_target_counts_the_object_outside_the_box_too() -> None:
    predicted = torch.zeros(1, 28, 28)
    predicted[0, :, :14] = 0.9  # the left half
    target = torch.zeros(1, 28, 28)
    target[0, :14] = 1.0  # the upper half
    box = torch.tensor([100.0])
    inside_only = iou_targets(predicted, target, torch.tensor([50.0]), box)
    assert float(inside_only) == pytest.approx(25 / 75)
    larger = iou_targets(predicted, target, torch.tensor([80.0]), box)
    assert float(larger) == pytest.approx(25 / (50 + 80 - 25))


def scene(seed: int) -> tuple[torch.Tensor, Target]:
    """A bright ellipse (1) and a dark box (2) on noise, 96 by 128."""
    rng = np.random.default_rng(seed)
    image = rng.uniform(0.4, 0.6, (3, 96, 128)).astype(np.float32)
    v, u = np.mgrid[:96, :128]
    ellipse = ((u - 40) / 26) ** 2 + ((v - 48) / 34) ** 2 < 1
    box = (u >= 78) & (u < 118) & (v >= 20) & (v < 70)
    image[0, ellipse], image[2, box] = 1.0, 0.0
    masks = torch.from_numpy(np.stack([ellipse, box]))
    boxes = torch.tensor([[14.0, 14.0, 67.0, 83.0], [78.0, 20.0, 118.0, 70.0]])
    return torch.from_numpy(image), Target(boxes, torch.tensor([1, 2]), masks)


@pytest.mark.parametrize("rois", ["proposals", "objects"])
def test_losses_are_finite_also_without_objects(rois: str) -> None:
    torch.manual_seed(0)
    model = MaskRCNN(TINY)
    image, target = scene(0)
    empty = Target(target.boxes[:0], target.labels[:0], target.masks[:0])
    generator = torch.Generator().manual_seed(0)
    for targets in ([target, empty],) if rois == "proposals" else ([empty, empty],):
        only = "" if rois == "proposals" else "masks"
        losses = network_losses(model, [image, image], targets, generator, rois, only)  # type: ignore[arg-type]
        names = {"mask", "dice", "maskiou"}
        names |= {"objectness", "rpn_box", "class", "box"} if rois == "proposals" else set()
        assert set(losses) == names
        assert all(torch.isfinite(v) for v in losses.values())
        sum(losses.values(), torch.zeros(())).backward()


def test_boxes_alone_have_no_losses_of_masks_and_the_same_of_boxes() -> None:
    torch.manual_seed(0)
    model = MaskRCNN(TINY)
    image, target = scene(0)
    whole, alone = (
        network_losses(model, [image], [target], torch.Generator().manual_seed(0), "objects", only)
        for only in (cast(Only, ""), cast(Only, "boxes"))
    )
    assert set(alone) == {"objectness", "rpn_box", "class", "box"}
    assert all(torch.equal(alone[name], whole[name]) for name in alone)


def learner() -> MaskRCNN:
    """A tiny network on the real MobileNetV2, which is not trained."""
    torch.manual_seed(0)
    model = MaskRCNN(TINY)
    load_mobilenet(model, shared("weights/mobilenet_v2_imagenet_folded.pth"))
    model.backbone.body.requires_grad_(False)
    return model


def descend(model: MaskRCNN, steps: int, rois: Literal["proposals", "objects"]) -> list[float]:
    """Sum of the losses at each step on one image."""
    image, target = scene(0)
    generator = torch.Generator().manual_seed(0)
    optimiser = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], 3e-3)
    only: Only = "" if rois == "proposals" else "masks"
    totals = []
    for _ in range(steps):
        losses = network_losses(model, [image], [target], generator, rois, only)
        total = sum(losses.values(), torch.zeros(()))
        optimiser.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 5.0)
        optimiser.step()
        totals.append(float(total.detach()))
    return totals


def test_the_network_overfits_the_masks_of_one_image() -> None:
    model = learner()
    descend(model, 60, "objects")
    image, target = scene(0)
    given = ClassifiedBoxes(target.boxes, target.labels, torch.ones(2), torch.eye(3)[1:])
    with torch.inference_mode():
        result = model.eval().segment([image], [given])[0]
    masks = paste(result.masks, target.boxes, (96, 128)) > 0.5
    overlap = (masks & target.masks).sum((1, 2)) / (masks | target.masks).sum((1, 2))
    assert overlap.min() > 0.85
    torch.testing.assert_close(result.mask_ious, overlap, atol=0.15, rtol=0)


def test_the_total_loss_decreases() -> None:
    totals = descend(learner(), 10, "proposals")
    assert np.mean(totals[-3:]) < 0.6 * np.mean(totals[:2])
