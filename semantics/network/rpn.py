"""The region proposal network (Ren et al. 2015): objectness and offsets of anchors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from bmask_slam.semantics.network import boxes as box_ops
from bmask_slam.semantics.network.anchors import make_anchors
from bmask_slam.semantics.network.backbone.layers import conv_stack, draw_normal
from bmask_slam.semantics.network.config import NetworkConfig, ProposalConfig
from bmask_slam.semantics.network.images import ImageBatch
from bmask_slam.semantics.network.nms import grouped_nms

MIN_SIZE_PX = 1e-3


class RPNHead(nn.Module):
    """The convolutions of the RPN, the same at every pyramid level."""

    def __init__(self, channels: int, convs: int, anchors: int) -> None:
        super().__init__()
        self.conv = nn.Sequential(*conv_stack(channels, channels, convs, "none"))
        self.cls_logits = nn.Conv2d(channels, anchors, 1)
        self.bbox_pred = nn.Conv2d(channels, 4 * anchors, 1)
        for conv in self.modules():
            if isinstance(conv, nn.Conv2d):
                draw_normal(conv.weight, 0.01)

    def forward(self, levels: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        """Logits (B, A_l) and offsets (B, A_l, 4) of each level, in the anchors' order."""
        logits, offsets = [], []
        for level in levels:
            x = self.conv(level)
            logits.append(self.cls_logits(x).permute(0, 2, 3, 1).flatten(1))
            moved = self.bbox_pred(x).permute(0, 2, 3, 1)
            offsets.append(moved.reshape(len(x), -1, 4))
        return logits, offsets


class RegionProposalNetwork(nn.Module):
    """Proposals from anchors: scored, moved by their offsets, suppressed."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.head = RPNHead(config.channels, config.rpn_convs, config.anchors.count)
        self.config = config.proposals
        self.anchors = config.anchors

    def forward(self, levels: Sequence[Tensor], batch: ImageBatch) -> list[Tensor]:
        """Proposals (N <= after_nms, 4) of each image, best first, in pixels of the batch."""
        logits, offsets = self.head(levels)
        anchors = make_anchors(levels, batch.size, self.anchors)
        return select_proposals(anchors, logits, offsets, batch.sizes, self.config)


@torch.no_grad()
def select_proposals(
    anchors: Sequence[Tensor],
    logits: Sequence[Tensor],
    offsets: Sequence[Tensor],
    sizes: Sequence[tuple[int, int]],
    config: ProposalConfig,
) -> list[Tensor]:
    """The best anchors of each image, moved by their offsets, without near duplicates.

    Args:
        anchors: (A_l, 4) of each level.
        logits, offsets: (B, A_l) and (B, A_l, 4) of each level.
        sizes: (height, width) of each image, to which proposals are clipped.
        config: numbers of boxes and overlap of the suppression.

    Returns:
        (N, 4) of each image, best first. The suppression compares boxes of one level only.
    """
    best = [level.topk(min(config.before_nms, level.shape[1]), dim=1) for level in logits]
    proposals = []
    for b, size in enumerate(sizes):
        moved, scores, groups = [], [], []
        for k, top in enumerate(best):
            chosen = top.indices[b]
            box = box_ops.decode(
                offsets[k][b, chosen, None], anchors[k][chosen], box_ops.RPN_WEIGHTS
            )
            moved.append(box_ops.clip(box[:, 0], size))
            scores.append(top.values[b].sigmoid())
            groups.append(torch.full_like(chosen, k))
        boxes, score, group = torch.cat(moved), torch.cat(scores), torch.cat(groups)
        large = box_ops.at_least(boxes, MIN_SIZE_PX)
        boxes, score, group = boxes[large], score[large], group[large]
        proposals.append(
            boxes[grouped_nms(boxes, score, group, config.nms_iou)[: config.after_nms]]
        )
    return proposals
