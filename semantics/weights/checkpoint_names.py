"""Parameter names of other programs and versions, translated to this network's own."""

from __future__ import annotations

import re
from collections.abc import Mapping

from torch import Tensor

State = dict[str, Tensor]

OLD_TORCHVISION = (
    (r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d)\.(weight|bias)$", r"\1.0.\2"),
    (r"^rpn\.head\.conv\.(weight|bias)$", r"rpn.head.conv.0.0.\1"),
    (r"^roi_heads\.mask_head\.mask_fcn1\.", "roi_heads.mask_head.0.0."),
    (r"^roi_heads\.mask_head\.mask_fcn2\.", "roi_heads.mask_head.1.0."),
    (r"^roi_heads\.mask_head\.mask_fcn3\.", "roi_heads.mask_head.2.0."),
    (r"^roi_heads\.mask_head\.mask_fcn4\.", "roi_heads.mask_head.3.0."),
)
"""Names in torchvision's published files, which are those of its first versions."""

MASK_SCORING = (
    (r"^backbone\.body\.stem\.", "backbone.body."),
    *((rf"^backbone\.fpn\.fpn_inner{k}\.", f"backbone.fpn.inner_blocks.{k - 1}.0.")
      for k in range(1, 5)),
    *((rf"^backbone\.fpn\.fpn_layer{k}\.", f"backbone.fpn.layer_blocks.{k - 1}.0.")
      for k in range(1, 5)),
    (r"^roi_heads\.box\.feature_extractor\.", "roi_heads.box_head."),
    (r"^roi_heads\.box\.predictor\.", "roi_heads.box_predictor."),
    (r"^roi_heads\.mask\.feature_extractor\.", "roi_heads.mask_head."),
    (r"^roi_heads\.mask\.predictor\.", "roi_heads.mask_predictor."),
    (r"^roi_heads\.maskiou\.feature_extractor\.maskiou_fcn",
     "roi_heads.maskiou_head.convs.maskiou_fcn"),
    (r"^roi_heads\.maskiou\.feature_extractor\.", "roi_heads.maskiou_head."),
    (r"^roi_heads\.maskiou\.predictor\.", "roi_heads.maskiou_head."),
)  # fmt: skip
"""Names in the original Mask Scoring R-CNN, which is built on maskrcnn-benchmark."""
MASK_SCORING_SIGN = "roi_heads.box.feature_extractor.fc6.weight"
BATCHES = "num_batches_tracked"
"""End of the name of batch norm's counter, which only training reads."""
PYRAMID_NORM = "backbone.fpn.inner_blocks.0.1.weight"
"""A name that torchvision's v2 has and its v1 lacks."""
_CONSTANTS = re.compile(r"\.anchor_generator\.cell_anchors\.|\.body\..*num_batches_tracked$")


def current_names(state: Mapping[str, Tensor]) -> State:
    """The weights under this network's names; current names are kept.

    The batch norm of v1 that was trained from scratch becomes one with fixed statistics.
    """
    plain = {name.removeprefix("module."): value for name, value in state.items()}
    if not is_mask_scoring(plain):
        if PYRAMID_NORM not in plain:
            plain = {name: value for name, value in plain.items() if not name.endswith(BATCHES)}
        return _renamed(plain, OLD_TORCHVISION)
    plain = {name: value for name, value in plain.items() if not _CONSTANTS.search(name)}
    renamed = _renamed(_renamed(plain, MASK_SCORING), OLD_TORCHVISION)
    first = "backbone.body.conv1.weight"
    if first in renamed:
        renamed[first] = renamed[first].flip(1)  # trained on blue, green, red
    return renamed


def is_mask_scoring(state: Mapping[str, Tensor]) -> bool:
    """Whether the names are those of the original Mask Scoring R-CNN."""
    return any(name.removeprefix("module.") == MASK_SCORING_SIGN for name in state)


def _renamed(state: Mapping[str, Tensor], rules: tuple[tuple[str, str], ...]) -> State:
    renamed = {}
    for name, value in state.items():
        new = name
        for pattern, replacement in rules:
            new = re.sub(pattern, replacement, new)
        renamed[new] = value
    return renamed
