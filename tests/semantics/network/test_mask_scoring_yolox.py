"""Masks on YOLOX-Nano's features: where their features lie, and that the heads can learn."""

from __future__ import annotations

import pytest
import torch
from repository import shared

from bmask_slam.semantics.network.yolox.mask_scoring import MaskScoringYolox, _aligned, around
from bmask_slam.semantics.network.yolox.network import Features
from bmask_slam.semantics.training.targets import Target
from bmask_slam.semantics.training.yolox_losses import yolox_losses
from bmask_slam.semantics.weights.light_weights import new_light
from bmask_slam.semantics.weights.yolox_onnx import load_onnx


@pytest.mark.parametrize("stride", [2, 4, 8])
def test_features_are_sampled_where_the_box_is(stride: int) -> None:
    """A level that holds its cells' own centres gives the centres of the bins."""
    size = 160
    centres = torch.arange(size // stride) * stride + 0.5 * stride
    x = centres.expand(size // stride, -1)
    level = torch.stack([x, x.T])[None]
    box = torch.tensor([[30.0, 40.0, 86.0, 124.0]])
    found = _aligned(level, stride, [box], 14)[0]
    steps = (torch.arange(14) + 0.5) / 14
    torch.testing.assert_close(found[0, 5], 30 + 56 * steps)
    torch.testing.assert_close(found[1, :, 5], 40 + 84 * steps)


def test_masks_cover_the_boxes_and_a_margin() -> None:
    assert around(torch.tensor([[10.0, 20.0, 30.0, 60.0]])).tolist() == [[8, 16, 32, 64]]


def test_boxes_of_several_images_get_their_own_features() -> None:
    torch.manual_seed(0)
    model = MaskScoringYolox().eval()
    boxes = [torch.tensor([[3.0, 5.0, 40.0, 60.0]]), torch.tensor([[20.0, 8.0, 50.0, 50.0]])]
    images = torch.rand(2, 3, 64, 96) * 255
    with torch.inference_mode():
        masks, ious = model.masks(model.detector.features(images), boxes)
        for k in range(2):
            one: Features = model.detector.features(images[k : k + 1])
            mask, iou = model.masks(one, [boxes[k]])
            torch.testing.assert_close(masks[k], mask[0], atol=1e-4, rtol=1e-4)
            torch.testing.assert_close(ious[k], iou[0], atol=1e-4, rtol=1e-4)


def test_the_heads_learn_one_object_and_the_detector_does_not() -> None:
    torch.manual_seed(0)
    model = new_light(load_onnx(shared("weights/yolox_nano.onnx"))).model
    before = {k: v.clone() for k, v in model.detector.state_dict().items()}
    image = torch.rand(3, 96, 128) * 0.2
    mask = torch.zeros(1, 96, 128, dtype=torch.bool)
    mask[0, 20:70, 30:60] = True
    image[:, mask[0]] += 0.7
    target = Target(torch.tensor([[30.0, 20.0, 60.0, 70.0]]), torch.tensor([1]), mask)
    optimiser = torch.optim.AdamW(model.parameters(), 2e-3)
    sums = []
    for step in range(30):
        losses = yolox_losses(model, [image], [target], torch.Generator().manual_seed(step))
        sums.append({k: float(v.detach()) for k, v in losses.items()})
        optimiser.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        optimiser.step()
    assert sums[-1]["mask"] < 0.7 * sums[0]["mask"]
    assert sums[-1]["dice"] < 0.7 * sums[0]["dice"]
    after = model.detector.state_dict()
    assert all(torch.equal(after[k], v) for k, v in before.items())
