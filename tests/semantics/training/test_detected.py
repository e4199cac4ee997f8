"""Examples of a detector's boxes against the network's own masks; the MaskIoU head learns."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import torch

from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.config import ImageConfig, NetworkConfig
from bmask_slam.semantics.network.mask_heads import expected_iou
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.network.paste import paste
from bmask_slam.semantics.segmenters.network_segmenter import segment_both_ways
from bmask_slam.semantics.training.detected import (
    DetectedConfig,
    Examples,
    _predicted_ious,
    examples,
    mask_iou,
    train_maskiou,
)
from bmask_slam.semantics.training.targets import Target

TINY = NetworkConfig(
    classes=3, backbone="mobilenet_v2", norm="none", channels=8, box_hidden=8, mask_channels=8,
    maskiou_channels=8, maskiou_hidden=16, class_agnostic=True, mask_context=1.2,
    image=ImageConfig(96, 128),
)  # fmt: skip
BOXES = torch.tensor([
    [8.0, 6.0, 60.0, 70.0],  # on the first object
    [8.0, 6.0, 60.0, 70.0],  # there, of another class
    [30.0, 30.0, 66.0, 76.0],  # badly placed
    [80.0, 60.0, 100.0, 80.0],  # on nothing
    [8.0, 6.0, 60.0, 70.0],  # well placed, of a low score
    [30.0, 30.0, 66.0, 76.0],  # badly placed, of a low score
])  # fmt: skip
LABELS = torch.tensor([1, 2, 1, 1, 1, 1])
SCORES = torch.tensor([0.9, 0.9, 0.5, 0.5, 0.01, 0.01])
SELECTED = [0, 2, 4]


def scene() -> tuple[MaskRCNN, torch.Tensor, Target]:
    """A network with random weights, an image (3, 96, 128), and two objects of a class in it."""
    torch.manual_seed(0)
    model = MaskRCNN(TINY).eval()
    with torch.no_grad():
        model.roi_heads.mask_predictor.mask_fcn_logits.weight.normal_(std=2)
        model.roi_heads.mask_predictor.mask_fcn_logits.bias.fill_(0.5)
    masks = torch.zeros(2, 96, 128, dtype=torch.bool)
    masks[0, 10:70, 10:60] = True
    masks[1, :8, 120:] = True
    boxes = torch.tensor([[10.0, 10.0, 60.0, 70.0], [120.0, 0.0, 128.0, 8.0]])
    return model, torch.rand(3, 96, 128), Target(boxes, torch.tensor([1, 1]), masks)


def test_mask_overlaps_equal_pixel_counts() -> None:
    masks = torch.rand(5, 9, 7) > torch.tensor([0.2, 0.5, 0.8, 0.5, 2.0])[:, None, None]
    found = mask_iou(masks, masks[1:])
    for i, a in enumerate(masks):
        for k, b in enumerate(masks[1:]):
            either = int((a | b).sum())
            assert abs(float(found[i, k]) - (int((a & b).sum()) / either if either else 0)) < 1e-6


def test_examples_hold_masks_and_scores_of_both_passes() -> None:
    model, image, target = scene()
    found = ClassifiedBoxes(BOXES, LABELS, SCORES, torch.full((6, 3), 1 / 3))
    given = examples(model, image, found, target, DetectedConfig())
    assert len(given) == len(SELECTED)
    with torch.inference_mode():
        whole = segment_both_ways(model, image, found)
    torch.testing.assert_close(given.masks.float(), whole.masks[SELECTED], atol=2e-3, rtol=0)
    pasted = paste(whole.masks, whole.mask_boxes, (96, 128))[SELECTED] > 0.5
    best = mask_iou(pasted, target.masks).amax(dim=1)
    torch.testing.assert_close(given.ious, best)
    assert (given.ious > 0).all()


def test_a_mirrored_example_equals_that_of_the_mirrored_image() -> None:
    model, image, target = scene()
    mirrored = Target(
        torch.tensor([[68.0, 10.0, 118.0, 70.0], [0.0, 0.0, 8.0, 8.0]]),
        target.labels,
        target.masks.flip(2),
    )
    found = ClassifiedBoxes(BOXES[:1], LABELS[:1], SCORES[:1], torch.full((1, 3), 1 / 3))
    turned = replace(found, boxes=torch.tensor([[68.0, 6.0, 120.0, 70.0]]))
    head = model.roi_heads.maskiou_head
    assert head is not None
    config = DetectedConfig()
    here = examples(model, image, found, target, config)
    there = examples(model, image.flip(2), turned, mirrored, config)
    first = torch.tensor([0])
    with torch.no_grad():
        other_way = _predicted_ious(head, here, first, torch.tensor([1]))
        same = _predicted_ious(head, there, first, torch.tensor([0]))
    torch.testing.assert_close(other_way, same, atol=1e-3, rtol=0)


def drawn(count: int) -> Examples:
    """Masks whose true IoU is half of the expected one."""
    generator = torch.Generator().manual_seed(0)
    masks = torch.rand((count, 28, 28), generator=generator).half()
    masks *= torch.rand((count, 1, 1), generator=generator).half()
    features = torch.randn((count, 2, 8, 14, 14), generator=generator).half()
    labels = torch.ones(count, dtype=torch.int64)
    return Examples(features, masks, labels, expected_iou(masks.float()) / 2)


def test_the_mean_with_the_expected_iou_approaches_the_true_iou() -> None:
    head = scene()[0].roi_heads.maskiou_head
    assert head is not None
    given, config = drawn(128), DetectedConfig(epochs=30, rate=3e-3)
    again = copy.deepcopy(head)
    error = train_maskiou(head, given, config, lambda *_: None)
    assert error < 0.3 * float(given.ious.var())
    assert not head.training
    assert train_maskiou(again, given, config, lambda *_: None) == error
    for one, other in zip(head.parameters(), again.parameters(), strict=True):
        np.testing.assert_array_equal(one.detach(), other.detach())
