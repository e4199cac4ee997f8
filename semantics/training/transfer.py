"""Transfer of a trained network to other labels or anchors."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from bmask_slam.semantics.labels import LabelSet
from bmask_slam.semantics.network.config import NetworkConfig
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork

PER_CLASS = {
    "roi_heads.box_predictor.cls_score": 1,
    "roi_heads.box_predictor.bbox_pred": 4,
    "roi_heads.mask_predictor.mask_fcn_logits": 1,
    "roi_heads.maskiou_head.maskiou": 1,
}
"""Layers with outputs for each class, and the number of outputs a class."""
PER_ANCHOR = ("rpn.head.cls_logits", "rpn.head.bbox_pred")
"""Layers with outputs for each anchor of a cell, those of half size last."""


def transferred(
    network: TrainedNetwork, labels: LabelSet, like: NetworkConfig | None = None
) -> TrainedNetwork:
    """The network with other labels and a MaskIoU head.

    Parameters that do not depend on the classes are copied; in layers that do, the rows of classes
    of the same name and of the background; in the RPN, the rows of existing anchors. New rows and a
    new MaskIoU head are initialised at random. ``like`` gives the anchors and the numbers of
    proposals and detections.
    """
    config = replace(network.model.config, classes=len(labels))
    config = config if config.maskiou_channels else config.with_maskiou()
    if like is not None:
        shape = {name: getattr(like, name) for name in ("anchors", "proposals", "detections")}
        config = replace(config, **shape)
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
        elif layer in PER_ANCHOR:
            both = min(len(value), len(old[name]))
            value[:both] = old[name][:both]
        else:
            value.copy_(old[name])
    return TrainedNetwork(model, labels)


@torch.no_grad()
def _copy_rows(new: Tensor, old: Tensor, pairs: list[tuple[int, int]], each: int) -> None:
    """Copy the outputs of classes (new label, old label), ``each`` rows a class."""
    for to, origin in pairs:
        new[to * each : (to + 1) * each] = old[origin * each : (origin + 1) * each]
