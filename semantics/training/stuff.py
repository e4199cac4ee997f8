"""Training of the head that gives every pixel a class, on the detector as it is."""

from __future__ import annotations

import copy
import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from bmask_slam.graph.arrays import Bytes, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import open_plain, whole_file
from bmask_slam.semantics.network.backbone.layers import keep_variance
from bmask_slam.semantics.network.yolox.layers import ConvSiLU
from bmask_slam.semantics.network.yolox.network import YoloxNano
from bmask_slam.semantics.network.yolox.stuff import StuffHead
from bmask_slam.semantics.training.loop import CURVES, cut_curves
from bmask_slam.semantics.training.stuff_images import IGNORED, Augmentation, augmented
from bmask_slam.semantics.weights.checkpoints import read_pickle

STATE = "stuff_training.pt"
LOSS_STRIDE = 4
PRETRAINED = ("stage_16.", "stage_32.")
"""Beginnings of the names of parameters that start from the detector's."""


@dataclass(frozen=True)
class StuffTrainingConfig:
    """How to train.

    Attributes:
        steps, batch: number of batches, images in each.
        rate: learning rate after the warm-up; it falls to nothing along a half cosine.
        pretrained_rate: factor on the rate for what starts from the detector's weights.
        warm_up: steps over which the rate rises.
        decay: weight decay.
        dropout: share of the last layer's channels that are left out.
        balance: classes are weighted by their share of the pixels to minus this power ...
        largest_weight: ... but by no more than this times the mean pixel's weight.
        lovasz: weight of the Lovász loss beside the cross-entropy.
        average: the weights that are kept are means over about 1 / (1 - average) steps.
        save_every: steps between checkpoints.
        seed: of weights, batches and augmentation.
    """

    steps: int = 2600
    batch: int = 8
    rate: float = 2e-3
    pretrained_rate: float = 0.2
    warm_up: int = 100
    decay: float = 0.02
    dropout: float = 0.1
    balance: float = 0.3
    largest_weight: float = 6.0
    lovasz: float = 0.5
    average: float = 0.998
    save_every: int = 100
    seed: int = 0
    augmentation: Augmentation = field(default_factory=Augmentation)


class _Normed(nn.Module):
    """A convolution with batch norm before its SiLU, as long as it is trained."""

    def __init__(self, conv: ConvSiLU) -> None:
        super().__init__()
        self.conv = conv
        self.norm = nn.BatchNorm2d(conv.out_channels, momentum=0.05)

    def forward(self, x: Tensor) -> Tensor:
        return F.silu(self.norm(nn.Conv2d.forward(self.conv, x)))

    @torch.no_grad()
    def folded(self) -> ConvSiLU:
        """The same function as one convolution: (W x + b - m) g / sqrt(v + e) + c."""
        mean, variance = self.norm.running_mean, self.norm.running_var
        assert mean is not None and variance is not None and self.conv.bias is not None
        scale = self.norm.weight * (variance + self.norm.eps).rsqrt()
        self.conv.weight.mul_(scale[:, None, None, None])
        self.conv.bias.sub_(mean).mul_(scale).add_(self.norm.bias)
        return self.conv


def with_norms(head: StuffHead) -> StuffHead:
    """The head with a batch norm after each convolution that does not start pretrained.

    Nor after that of the image's mean, whose statistics over a batch are of too few values.
    """
    for name, module in list(head.named_modules()):
        for key, child in list(module.named_children()):
            path = f"{name}.{key}" if name else key
            if isinstance(child, ConvSiLU) and not f"{path}.".startswith((*PRETRAINED, "whole.")):
                setattr(module, key, _Normed(child))
    return head


def without_norms(head: StuffHead) -> StuffHead:
    """A copy of the head in evaluation mode, its batch norms folded into the convolutions."""
    head = copy.deepcopy(head)
    for module in list(head.modules()):
        for key, child in list(module.named_children()):
            if isinstance(child, _Normed):
                setattr(module, key, child.folded())
    return head.eval()


def train_stuff(
    detector: YoloxNano,
    images: Sequence[tuple[Image, Bytes]],
    classes: int,
    out: Path,
    config: StuffTrainingConfig,
    progress: Callable[[int, int], None],
) -> StuffHead:
    """Train a head, with checkpoints in ``out`` from which the same call goes on.

    ``images`` are (H, W, 3), red first, each with its classes (H, W): 0..classes - 1, or IGNORED.
    """
    head = _first(detector, classes, config)
    kept = copy.deepcopy(head)
    head.logits.register_forward_pre_hook(lambda _, x: F.dropout2d(x[0], config.dropout))
    optimiser = _optimiser(head, config)
    weights = class_weights([labels for _, labels in images], classes, config)
    out.mkdir(parents=True, exist_ok=True)
    parts: dict[str, Any] = {"head": head, "kept": kept, "optimiser": optimiser}
    first = _resume(out, parts, config)
    with open_plain(out / CURVES, "a") as file:
        writer = csv.writer(file)
        for step in range(first, config.steps):
            _set_rate(optimiser, step, config)
            torch.manual_seed(config.seed * 1_000_003 + step)
            x, truth = _batch(images, step, config)
            losses = stuff_losses(detector, head, x, truth, weights)
            total = losses["cross-entropy"] + config.lovasz * losses["lovasz"]
            optimiser.zero_grad(set_to_none=True)
            total.backward()
            nn.utils.clip_grad_norm_(head.parameters(), 5.0)
            optimiser.step()
            _average(kept, head, min(config.average, (step + 1) / (step + 10)))
            writer.writerows([step, n, f"{float(v.detach()):.6g}"] for n, v in losses.items())
            if (step + 1) % config.save_every == 0 or step + 1 == config.steps:
                file.flush()
                _save(out, parts, step + 1, config)
            progress(step + 1, config.steps)
    return without_norms(kept)


def stuff_losses(
    detector: YoloxNano, head: StuffHead, x: Tensor, truth: Tensor, weights: Tensor
) -> dict[str, Tensor]:
    """Weighted cross-entropy and Lovász loss.

    Args:
        x: images (B, 3, H, W), red first in 0..255.
        truth: (B, H, W) int64.
        weights: (C,) of the classes.
    """
    with torch.autocast("cpu", torch.bfloat16):
        with torch.no_grad():
            features = detector.features(x)
            detections = detector.detections(features)
        cells = head(features, detections)
    logits = F.interpolate(cells.float(), scale_factor=8 / LOSS_STRIDE, mode="bilinear")
    half = LOSS_STRIDE // 2
    truth = truth[:, half::LOSS_STRIDE, half::LOSS_STRIDE]
    entropy = F.cross_entropy(logits, truth, weights, ignore_index=IGNORED)
    some = logits[:, :, ::2, ::2].softmax(dim=1).permute(1, 0, 2, 3).flatten(1)
    where = truth[:, ::2, ::2].flatten()
    known = where != IGNORED
    return {"cross-entropy": entropy, "lovasz": lovasz_softmax(some[:, known], where[known])}


def lovasz_softmax(probabilities: Tensor, truth: Tensor) -> Tensor:
    """The Lovász extension of 1 - IoU, mean over the classes present (Berman et al. 2018).

    ``probabilities`` (C, P) of pixels with classes ``truth`` (P,).
    """
    present = torch.unique(truth)
    if len(present) == 0:
        return probabilities.sum() * 0
    is_class = (truth == present[:, None]).to(probabilities.dtype)
    errors, order = (is_class - probabilities[present]).abs().sort(dim=1, descending=True)
    with torch.no_grad():
        ordered = is_class.gather(1, order)
        total = ordered.sum(dim=1, keepdim=True)
        missed = total - ordered.cumsum(dim=1)
        union = total + (1 - ordered).cumsum(dim=1)
        loss = 1 - missed / union
        loss[:, 1:] -= loss[:, :-1].clone()
    return (errors * loss).sum(dim=1).mean()


def class_weights(labels: Sequence[Bytes], classes: int, config: StuffTrainingConfig) -> Tensor:
    """Weights (C,) of the cross-entropy; their mean over all known pixels is 1."""
    counts = np.zeros(256, np.int64)
    for image in labels:
        counts += np.bincount(image.ravel(), minlength=256)
    share = np.maximum(counts[:classes], 1) / max(counts[:classes].sum(), 1)
    weights = share**-config.balance
    for _ in range(8):
        weights = np.minimum(weights / (weights * share).sum(), config.largest_weight)
    return torch.from_numpy(weights).float()


def _first(detector: YoloxNano, classes: int, config: StuffTrainingConfig) -> StuffHead:
    """The head at the begin of its training."""
    torch.manual_seed(config.seed)
    head = StuffHead(classes)
    keep_variance(head)
    nn.init.normal_(head.logits.weight, std=0.05)
    head.begin_from(detector)
    return with_norms(head).train()


def _batch(
    images: Sequence[tuple[Image, Bytes]], step: int, config: StuffTrainingConfig
) -> tuple[Tensor, Tensor]:
    """A step's images (B, 3, H, W) and classes (B, H, W), which depend on seed and step alone.

    Each pass over the images has an order of its own.
    """
    rng = np.random.default_rng([config.seed, step])
    samples = []
    for k in range(step * config.batch, (step + 1) * config.batch):
        turn, at = divmod(k, len(images))
        order = np.random.default_rng([config.seed, 1 << 20, turn]).permutation(len(images))
        samples.append(augmented(*images[int(order[at])], config.augmentation, rng))
    x = torch.from_numpy(np.stack([s[0] for s in samples])).permute(0, 3, 1, 2)
    truth = torch.from_numpy(np.stack([s[1] for s in samples]))
    return x.float().contiguous(memory_format=torch.channels_last), truth.long()


def _optimiser(head: StuffHead, config: StuffTrainingConfig) -> torch.optim.Optimizer:
    """AdamW; neither biases nor norms decay."""
    groups = []
    for pretrained in (False, True):
        for decays in (False, True):
            chosen = [
                p
                for name, p in head.named_parameters()
                if name.startswith(PRETRAINED) == pretrained and (p.ndim > 1) == decays
            ]
            share = config.pretrained_rate if pretrained else 1.0
            decay = config.decay if decays else 0.0
            groups.append({"params": chosen, "weight_decay": decay, "share": share})
    return torch.optim.AdamW([g for g in groups if g["params"]], config.rate)


def _set_rate(optimiser: torch.optim.Optimizer, step: int, config: StuffTrainingConfig) -> None:
    """Linear warm-up, then half a cosine down to nothing."""
    warm = min((step + 1) / max(config.warm_up, 1), 1.0)
    cosine = 0.5 * (1 + math.cos(math.pi * step / config.steps))
    for group in optimiser.param_groups:
        group["lr"] = config.rate * warm * cosine * group["share"]


@torch.no_grad()
def _average(kept: nn.Module, head: nn.Module, share: float) -> None:
    """Move the kept weights towards the present ones."""
    for old, new in zip(kept.state_dict().values(), head.state_dict().values(), strict=True):
        if old.is_floating_point():
            old.lerp_(new, 1 - share)
        else:
            old.copy_(new)


def _save(out: Path, parts: dict[str, Any], step: int, config: StuffTrainingConfig) -> None:
    content = {name: part.state_dict() for name, part in parts.items()}
    with whole_file(out / STATE) as temporary:
        torch.save({**content, "step": step, "config": str(asdict(config))}, temporary)


def _resume(out: Path, parts: dict[str, Any], config: StuffTrainingConfig) -> int:
    """Load the checkpoint of this training, if there is one; the next step."""
    if not (out / STATE).is_file():
        cut_curves(out / CURVES, 0)
        return 0
    content = read_pickle(out / STATE)
    if content["config"] != str(asdict(config)):
        raise InputError(f"{out}: holds a training with other settings; choose another folder")
    for name, part in parts.items():
        part.load_state_dict(content[name])
    cut_curves(out / CURVES, int(content["step"]))
    return int(content["step"])
