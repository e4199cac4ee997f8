"""Non-maximum suppression as a fixed point of matrix products, without a loop over boxes."""

from __future__ import annotations

import torch
from torch import Tensor

from bmask_slam.semantics.network.boxes import iou


def nms(boxes: Tensor, scores: Tensor, max_iou: float) -> Tensor:
    """Indices of the boxes (N, 4) that are kept, best score (N,) first.

    Greedy suppression keeps a box unless a better box that is itself KEPT overlaps it by more
    than ``max_iou``. With the matrix S[i, j] = (i better than j and overlapping), that is
    keep[j] = not any_i(keep[i] and S[i, j]). Starting from all kept and repeating this until
    nothing changes gives the greedy result: after k iterations the k best boxes are final, and in
    practice all are after about as many iterations as the longest chain of suppressions.
    """
    order = scores.argsort(descending=True, stable=True)
    suppresses = (iou(boxes[order], boxes[order]) > max_iou).triu(diagonal=1).float()
    keep = torch.ones(len(boxes), device=boxes.device)
    while True:
        updated = (keep @ suppresses == 0).to(keep.dtype)
        if torch.equal(updated, keep):
            return order[keep.bool()]
        keep = updated


def grouped_nms(boxes: Tensor, scores: Tensor, groups: Tensor, max_iou: float) -> Tensor:
    """The same within each group (N,), such as a class or a level."""
    kept = []
    for group in groups.unique():
        members = torch.nonzero(groups == group).squeeze(1)
        kept.append(members[nms(boxes[members], scores[members], max_iou)])
    if not kept:
        return groups.new_zeros(0, dtype=torch.int64)
    indices = torch.cat(kept)
    return indices[scores[indices].argsort(descending=True, stable=True)]
