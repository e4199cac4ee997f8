"""Training of the MaskIoU head alone, in the boxes of another detector."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from bmask_slam.graph.arrays import Image
from bmask_slam.semantics.network import mask_heads
from bmask_slam.semantics.network.box_head import ClassifiedBoxes
from bmask_slam.semantics.network.boxes import enlarged, iou, mirrored, rescale
from bmask_slam.semantics.network.images import prepare
from bmask_slam.semantics.network.mask_heads import MaskIoUHead, expected_iou, of_class
from bmask_slam.semantics.network.model import ROI_LEVELS, MaskRCNN
from bmask_slam.semantics.network.paste import paste
from bmask_slam.semantics.network.roi_align import feature_table, roi_align
from bmask_slam.semantics.training.dataset import Dataset, as_tensors
from bmask_slam.semantics.training.targets import Target

MASK_THRESHOLD = 0.5
MATCH_IOU = 0.5
WARM_UP = 20
OFFSET_EXAMPLES = 256
"""Number of examples that the initial offset of the head's values is estimated from."""


@dataclass(frozen=True)
class DetectedConfig:
    """Which boxes are examples, and how to train.

    ``min_overlap``: least overlap of a box with an object of its class; low, so that badly placed
    boxes are examples too. ``min_score``: class score below which only well placed boxes are used,
    since there are many others.
    """

    min_overlap: float = 0.1
    min_score: float = 0.03
    epochs: int = 3
    batch: int = 64
    rate: float = 1e-4
    decay: float = 1e-2
    max_gradient: float = 5.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Examples:
    """Boxes of a detector as input of the MaskIoU head.

    Attributes:
        features: (N, 2, C, 14, 14) half precision, in the image and in its mirror image.
        masks: (N, 28, 28) half precision, the mean of both, oriented as in the image.
        labels: (N,) int64.
        ious: (N,) largest IoU of the mask, pasted into the image, with an object of its class.
    """

    features: Tensor
    masks: Tensor
    labels: Tensor
    ious: Tensor

    def __len__(self) -> int:
        return len(self.ious)


def collect(
    model: MaskRCNN,
    data: Dataset,
    detect: Callable[[Image], ClassifiedBoxes],
    config: DetectedConfig,
    progress: Callable[[int, int], None],
) -> Examples:
    """The examples of every image of a data set; ``detect`` takes (H, W, 3), red first."""
    parts = []
    for k in range(len(data)):
        sample = data.load(k)
        image, target = as_tensors(sample)
        parts.append(examples(model, image, detect(sample.image), target, config))
        progress(k + 1, len(data))
    columns = zip(*((p.features, p.masks, p.labels, p.ious) for p in parts), strict=True)
    return Examples(*(torch.cat(column) for column in columns))


@torch.inference_mode()
def examples(
    model: MaskRCNN, image: Tensor, found: ClassifiedBoxes, target: Target, config: DetectedConfig
) -> Examples:
    """The examples of one image (3, H, W) with at least one object."""
    same = found.labels[:, None] == target.labels
    overlap = (iou(found.boxes, target.boxes) * same).amax(dim=1)
    scored = (found.scores > config.min_score) | (overlap >= MATCH_IOU)
    kept = (overlap >= config.min_overlap) & scored
    boxes, labels = found.boxes[kept], found.labels[kept]
    features = _both_ways(model, image, boxes)
    heads = model.roi_heads
    logits = heads.mask_predictor(heads.mask_head(features.flatten(0, 1)))
    every = of_class(logits, labels.repeat_interleave(2)).sigmoid().unflatten(0, (-1, 2))
    masks = (every[:, 0] + every[:, 1].flip(2)) / 2
    around = enlarged(boxes, model.config.mask_context)
    pasted = paste(masks, around, (image.shape[1], image.shape[2])) > MASK_THRESHOLD
    ious = (mask_iou(pasted, target.masks) * same[kept]).amax(dim=1)
    filled = pasted.flatten(1).any(dim=1)
    return Examples(features[filled].half(), masks[filled].half(), labels[filled], ious[filled])


def _both_ways(model: MaskRCNN, image: Tensor, boxes: Tensor) -> Tensor:
    """RoI features (N, 2, C, 14, 14) of boxes (N, 4) in an image and in its mirror image."""
    batch = prepare([image, image.flip(2)], model.config.image)
    table = feature_table(model.backbone(batch.tensor)[:ROI_LEVELS], batch.size[0])
    around = [
        enlarged(rescale(b, old, new), model.config.mask_context)
        for b, old, new in zip(
            (boxes, mirrored(boxes, image.shape[2])), batch.original_sizes, batch.sizes, strict=True
        )
    ]
    features = roi_align(table, around, mask_heads.BINS)
    return torch.stack(features.split(len(boxes)), dim=1)


def mask_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU (N, G) of masks (N, H, W) and (G, H, W); 0 if both are empty."""
    both = a.flatten(1).float() @ b.flatten(1).float().T
    either = a.sum(dim=(1, 2))[:, None] + b.sum(dim=(1, 2)) - both
    return both / either.clamp(min=1)


def train_maskiou(
    head: MaskIoUHead, given: Examples, config: DetectedConfig, progress: Callable[[int, int], None]
) -> float:
    """Train so that the mean of the head's value and the expected IoU is the true IoU.

    That mean is the mask score of ``segment_both_ways``. Returns the mean squared error over the
    second half of the steps.
    """
    rng = np.random.default_rng(config.seed)
    expected = expected_iou(given.masks.float())
    _remove_offset(head, given, expected, rng)
    optimiser = torch.optim.AdamW(head.parameters(), config.rate, weight_decay=config.decay)
    order = np.concatenate([rng.permutation(len(given)) for _ in range(config.epochs + 1)])
    steps = max(config.epochs * len(given) // config.batch, 1)
    errors = []
    head.train()
    for step in range(steps):
        chosen = order[step * config.batch : (step + 1) * config.batch]
        cosine = 0.5 * (1 + math.cos(math.pi * step / steps))
        for group in optimiser.param_groups:
            group["lr"] = config.rate * min((step + 1) / WARM_UP, 1) * cosine
        ways = torch.from_numpy(rng.integers(0, 2, len(chosen)))
        predicted = _predicted_ious(head, given, torch.from_numpy(chosen), ways)
        loss = ((predicted + expected[chosen]) / 2 - given.ious[chosen]).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(head.parameters(), config.max_gradient)
        optimiser.step()
        errors.append(float(loss.detach()))
        progress(step + 1, steps)
    head.eval()
    return float(np.mean(errors[steps // 2 :]))


@torch.no_grad()
def _remove_offset(
    head: MaskIoUHead, given: Examples, expected: Tensor, rng: np.random.Generator
) -> None:
    """Shift the head's values by a constant so that their mean error is zero."""
    some = torch.from_numpy(rng.choice(len(given), OFFSET_EXAMPLES))
    predicted = _predicted_ious(head, given, some, torch.zeros(len(some), dtype=torch.int64))
    head.maskiou.bias.add_((2 * given.ious[some] - expected[some] - predicted).mean())


def _predicted_ious(head: MaskIoUHead, given: Examples, chosen: Tensor, ways: Tensor) -> Tensor:
    """The head's values (B,) for chosen examples (B,), as they are (way 0) or mirrored (1)."""
    masks = given.masks[chosen].float()
    masks = torch.where(ways[:, None, None].bool(), masks.flip(2), masks)
    values = head(given.features[chosen, ways].float(), masks)
    return of_class(values, given.labels[chosen])
