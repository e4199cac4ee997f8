"""A trained network for another label set: what both know is kept, the rest starts anew."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from semantics.checkpoints import TrainedNetwork
from semantics.labels import LabelSet
from semantics.network.model import MaskRCNN

PER_CLASS = {
    "roi_heads.box_predictor.cls_score": 1,
    "roi_heads.box_predictor.bbox_pred": 4,
    "roi_heads.mask_predictor.mask_fcn_logits": 1,
    "roi_heads.maskiou_head.maskiou": 1,
}
"""Layers with outputs for each class, and how many a class."""


def transferred(network: TrainedNetwork, labels: LabelSet) -> TrainedNetwork:
    """The network with these labels and a MaskIoU head.

    Every parameter that does not depend on the classes is kept; in the layers that do, the rows
    of classes of the same name (and of the background) are kept. New rows, and a new MaskIoU
    head, are drawn at random.
    """
    config = replace(network.model.config, classes=len(labels))
    config = config if config.maskiou_channels else config.with_maskiou()
    model = MaskRCNN(config)
    old, new = network.model.state_dict(), model.state_dict()
    pairs = [
        (k, network.labels.names.index(name))
        for k, name in enumerate(labels.names)
        if name in network.labels.names
    ]
    for name, value in new.items():
        layer = name.rpartition(".")[0]
        if name not in old:
            continue
        if layer in PER_CLASS and len(old[name]) > 1:
            _copy_rows(value, old[name], pairs, PER_CLASS[layer])
        else:
            value.copy_(old[name])
    return TrainedNetwork(model, labels)


@torch.no_grad()
def _copy_rows(new: Tensor, old: Tensor, pairs: list[tuple[int, int]], each: int) -> None:
    """Copy the outputs of classes (new label, old label), ``each`` rows a class."""
    for to, origin in pairs:
        new[to * each : (to + 1) * each] = old[origin * each : (origin + 1) * each]
