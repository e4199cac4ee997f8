"""The MaskIoU head's input and use."""

from __future__ import annotations

from dataclasses import replace

import torch

from bmask_slam.semantics.network.config import NetworkConfig
from bmask_slam.semantics.network.mask_heads import MaskIoUHead, expected_iou
from bmask_slam.semantics.network.model import RoIHeads
from bmask_slam.semantics.network.roi_align import feature_table

CONFIG = NetworkConfig(
    classes=3, channels=6, box_hidden=8, mask_channels=5, maskiou_channels=4, maskiou_hidden=8
)


def test_the_mask_enters_as_the_last_channel_pooled_two_by_two() -> None:
    head = MaskIoUHead(CONFIG)
    recorded = []
    head.convs[0].register_forward_hook(lambda _m, inputs, _o: recorded.append(inputs[0]))
    features, masks = torch.rand(2, 6, 14, 14), torch.rand(2, 28, 28)
    assert head(features, masks).shape == (2, 3)
    assert recorded[0].shape == (2, 7, 14, 14)
    torch.testing.assert_close(recorded[0][:, :6], features)
    expected = masks.unfold(1, 2, 2).unfold(2, 2, 2).amax(dim=(3, 4))
    torch.testing.assert_close(recorded[0][:, 6], expected)


def test_masks_and_ious_of_the_predicted_label_are_used() -> None:
    torch.manual_seed(0)
    heads = RoIHeads(CONFIG).eval()
    table = feature_table([torch.randn(1, 6, 64 >> k, 64 >> k) for k in range(4)], 256)
    box = torch.tensor([[10.0, 20.0, 90.0, 120.0]])
    with torch.no_grad():
        last = heads.mask_predictor.mask_fcn_logits
        last.weight.zero_()
        last.bias.copy_(torch.tensor([-5.0, 0.0, 5.0]))  # one constant mask a class
        assert heads.maskiou_head is not None
        heads.maskiou_head.maskiou.weight.zero_()
        heads.maskiou_head.maskiou.bias.copy_(torch.tensor([0.1, 0.6, 1.7]))
        masks, ious = heads.masks(table, [box.repeat(2, 1)], torch.tensor([1, 2]))
    assert masks.shape == (2, 28, 28)
    torch.testing.assert_close(masks[:, 0, 0], torch.sigmoid(torch.tensor([0.0, 5.0])))
    torch.testing.assert_close(ious, torch.tensor([0.6, 1.0]))  # an IoU is at most 1


def test_without_the_head_every_mask_has_full_score() -> None:
    heads = RoIHeads(replace(CONFIG, maskiou_channels=0)).eval()
    table = feature_table([torch.randn(1, 6, 64 >> k, 64 >> k) for k in range(4)], 256)
    masks, ious = heads.masks(table, [torch.tensor([[0.0, 0.0, 50.0, 50.0]])], torch.tensor([1]))
    assert masks.shape == (1, 28, 28)
    assert ious.tolist() == [1.0]


def test_the_expected_iou_equals_that_of_sampled_masks() -> None:
    generator = torch.Generator().manual_seed(0)
    masks = (
        torch.rand(3, 28, 28, generator=generator) ** torch.tensor([0.3, 1.0, 2.0])[:, None, None]
    )
    drawn = torch.rand(400, 3, 28, 28, generator=generator) < masks
    found = masks > 0.5
    union = (drawn | found).sum(dim=(2, 3))
    mean = ((drawn & found).sum(dim=(2, 3)) / union).mean(dim=0)
    torch.testing.assert_close(expected_iou(masks), mean, atol=0.005, rtol=0)
    assert expected_iou(torch.zeros(1, 28, 28)).tolist() == [0.0]
