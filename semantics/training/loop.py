"""The training loop: batches, optimiser, loss curves, and checkpoints to resume from."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn

from bmask_slam.graph.errors import InputError, whole_number
from bmask_slam.graph.files.reading import in_short, read_lines
from bmask_slam.graph.files.whole_file import open_plain, whole_file
from bmask_slam.semantics.network.yolox.mask_scoring import MaskScoringYolox
from bmask_slam.semantics.training.dataset import (
    AugmentConfig,
    Dataset,
    JoinedDatasets,
    as_tensors,
    augmented,
)
from bmask_slam.semantics.training.losses import Losses, MaskRois, Only, network_losses
from bmask_slam.semantics.training.targets import Target
from bmask_slam.semantics.training.yolox_losses import yolox_losses
from bmask_slam.semantics.weights.checkpoints import TrainedNetwork, read_pickle, save_network
from bmask_slam.semantics.weights.light_weights import LightNetwork, save_light

_FOREIGN = (LookupError, TypeError, ValueError, AttributeError, RuntimeError, StopIteration)
"""What the use of a state raises that is not this training's."""
STATE = "training.pt"
CURVES, CURVES_HEAD = "losses.csv", "step,loss,value"
WEIGHTS = "weights.safetensors"
MASKIOU = "maskiou"
BODY = "backbone.body."
BOX_PARTS = ("rpn.", "roi_heads.box_")


@dataclass(frozen=True)
class TrainingConfig:
    """How to train.

    Attributes:
        steps: batches in all.
        batch: images in a batch.
        optimiser: "adamw", or "sgd" with momentum 0.9.
        rate: learning rate after the warm-up; it falls to nothing along a half cosine.
        body_rate: factor on the rate for the pretrained body.
        warm_up: steps over which the rate rises.
        decay: weight decay.
        max_gradient: largest norm of the gradient; it is scaled down to this.
        freeze: beginnings of the names of parameters that are not trained.
        only: "masks": all but the RPN and the box head, for a network whose boxes come from another
            detector; "maskiou": the MaskIoU head; "boxes": the RPN and the box head; "": all.
        crowd: images are drawn in proportion to their number of objects to this power: with 0 all
            images are equally likely, with 1 all objects.
        rois: where masks are trained: in the RPN's proposals, or in boxes around the objects.
        precision: "float32", or "mixed": float16 on a GPU, bfloat16 on a CPU.
        save_every: steps between checkpoints.
        seed: of batches, samples and augmentation.
    """

    steps: int = 2000
    batch: int = 2
    optimiser: Literal["adamw", "sgd"] = "adamw"
    rate: float = 5e-4
    body_rate: float = 0.2
    warm_up: int = 100
    decay: float = 1e-4
    max_gradient: float = 10.0
    freeze: tuple[str, ...] = ()
    only: Only = ""
    crowd: float = 0.0
    rois: MaskRois = "proposals"
    precision: Literal["float32", "mixed"] = "mixed"
    save_every: int = 200
    seed: int = 0
    augment: AugmentConfig = field(default_factory=AugmentConfig)

    def __post_init__(self) -> None:
        if self.steps < 1 or self.batch < 1 or self.rate <= 0:
            raise ValueError("steps and batch must be at least 1, the rate above 0")


def train(
    network: TrainedNetwork | LightNetwork,
    data: Dataset | JoinedDatasets,
    out: Path,
    config: TrainingConfig,
    progress: Callable[[int, int], None],
) -> Path:
    """Train and write weights, loss curves and a checkpoint; resume from one in ``out``.

    Returns:
        the weights file.

    Raises:
        InputError: ``out`` holds a training with another configuration, or a loss is not finite.
    """
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = network.model.to(device).train()
    trainable(model, config)
    optimiser = _optimiser(model, config)
    halves = device == "cuda" and config.precision == "mixed"
    scaler = torch.amp.GradScaler(device, enabled=halves)
    out.mkdir(parents=True, exist_ok=True)
    first = _resume(out, model, optimiser, config)
    with open_plain(out / CURVES, "a") as file:
        writer = csv.writer(file)
        for step in range(first, config.steps):
            _set_rate(optimiser, step, config)
            losses = _step_losses(model, data, step, config, device)
            total = sum(losses.values(), torch.zeros((), device=device))
            if not math.isfinite(value := float(total.detach())):
                raise InputError(f"step {step}: the loss is {value}; lower the rate {config.rate}")
            _descend(total, optimiser, scaler, config)
            _log(writer, step, losses)
            if (step + 1) % config.save_every == 0 or step + 1 == config.steps:
                file.flush()
                _save(out, model, optimiser, step + 1, config)
            progress(step + 1, config.steps)
    return _save_weights(network, out / WEIGHTS)


def _save_weights(network: TrainedNetwork | LightNetwork, path: Path) -> Path:
    network.model.eval()
    if isinstance(network, LightNetwork):
        save_light(network, path)
    else:
        save_network(network, path)
    return path


def _descend(
    loss: Tensor,
    optimiser: torch.optim.Optimizer,
    scaler: torch.amp.GradScaler,
    config: TrainingConfig,
) -> None:
    """One step of the optimiser, with a limited gradient."""
    optimiser.zero_grad(set_to_none=True)
    scaler.scale(loss).backward()
    scaler.unscale_(optimiser)
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    nn.utils.clip_grad_norm_(parameters, config.max_gradient)
    scaler.step(optimiser)
    scaler.update()


def trainable(model: nn.Module, config: TrainingConfig) -> list[nn.Parameter]:
    """The parameters to train; the others get no gradient.

    Raises:
        InputError: a name to freeze that no parameter begins with, or nothing left to train.
    """
    names = [name for name, _ in model.named_parameters()]
    for prefix in config.freeze:
        if not any(name.startswith(prefix) for name in names):
            raise InputError(f"--freeze {prefix}: no parameter begins with it; one is {names[0]}")
    for name, parameter in model.named_parameters():
        frozen = any(name.startswith(prefix) for prefix in config.freeze)
        parameter.requires_grad_(not frozen and _learns(name, config.only))
    chosen = [p for p in model.parameters() if p.requires_grad]
    if not chosen:
        raise InputError("training: every parameter is frozen; freeze less, or add a MaskIoU head")
    return chosen


def _learns(name: str, only: Only) -> bool:
    """Whether the parameter of this name is trained."""
    if only == MASKIOU:
        return f".{MASKIOU}" in name
    if only == "":
        return True
    return name.startswith(BOX_PARTS) == (only == "boxes")


def _optimiser(model: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """The optimiser of trainable parameters, in groups with their factor on the rate."""
    learning = [(n, p) for n, p in model.named_parameters() if p.requires_grad]
    groups = [
        {"params": [p for n, p in learning if n.startswith(BODY)], "share": config.body_rate},
        {"params": [p for n, p in learning if not n.startswith(BODY)], "share": 1.0},
    ]
    groups = [group for group in groups if group["params"]]
    if config.optimiser == "sgd":
        return torch.optim.SGD(groups, config.rate, momentum=0.9, weight_decay=config.decay)
    return torch.optim.AdamW(groups, config.rate, weight_decay=config.decay)


def _set_rate(optimiser: torch.optim.Optimizer, step: int, config: TrainingConfig) -> None:
    """Linear warm-up, then half a cosine down to nothing."""
    warm = min((step + 1) / max(config.warm_up, 1), 1.0)
    cosine = 0.5 * (1 + math.cos(math.pi * step / config.steps))
    for group in optimiser.param_groups:
        group["lr"] = config.rate * warm * cosine * group["share"]


def _step_losses(
    model: Any, data: Dataset | JoinedDatasets, step: int, config: TrainingConfig, device: str
) -> Losses:
    """The losses of a step's batch, which depends only on the seed and the step."""
    rng = np.random.default_rng([config.seed, step])
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    images, targets = zip(*_batch(data, rng, config, device), strict=True)
    kind = torch.float16 if device == "cuda" else torch.bfloat16
    with torch.autocast(device, kind, enabled=config.precision == "mixed"):
        if isinstance(model, MaskScoringYolox):
            losses = yolox_losses(model, images, targets, generator)
        else:
            losses = network_losses(model, images, targets, generator, config.rois, config.only)
    return {k: v.float() for k, v in losses.items() if k == MASKIOU or config.only != MASKIOU}


def _batch(
    data: Dataset | JoinedDatasets, rng: np.random.Generator, config: TrainingConfig, device: str
) -> Iterator[tuple[Tensor, Target]]:
    for index in draw_batch(data, rng, config):
        other = partial(data.load, int(rng.integers(len(data))))
        image, target = as_tensors(augmented(data.load(index), other, config.augment, rng))
        moved = Target(*(t.to(device) for t in (target.boxes, target.labels, target.masks)))
        yield image.to(device), moved


def draw_batch(
    data: Dataset | JoinedDatasets, rng: np.random.Generator, config: TrainingConfig
) -> list[int]:
    """Indices of a batch's images: all portrait or all landscape, so that padding is small."""
    chance = data.objects**config.crowd
    first = int(rng.choice(len(data), p=chance / chance.sum()))
    chance *= data.portrait == data.portrait[first]
    return [first, *rng.choice(len(data), config.batch - 1, p=chance / chance.sum()).tolist()]


def _log(writer: Any, step: int, losses: Losses) -> None:
    """Write one line for each loss: step, name, value."""
    for name, value in losses.items():
        writer.writerow([step, name, f"{float(value.detach()):.6g}"])


def _save(
    out: Path, model: nn.Module, optimiser: torch.optim.Optimizer, step: int, config: TrainingConfig
) -> None:
    content = {
        "model": model.state_dict(),
        "optimiser": optimiser.state_dict(),
        "step": step,
        "config": _comparable(config),
    }
    with whole_file(out / STATE) as temporary:
        torch.save(content, temporary)


def _resume(
    out: Path, model: nn.Module, optimiser: torch.optim.Optimizer, config: TrainingConfig
) -> int:
    """Load the checkpoint, if any, and cut the curves at it; the next step."""
    if not (out / STATE).is_file():
        cut_curves(out / CURVES, 0)
        return 0
    content, cure = read_pickle(out / STATE), "choose another --out or delete it"
    try:
        before, now = content["config"], _comparable(config)
        if before != now:
            key = next(k for k in now if before.get(k) != now[k])
            raise InputError(
                f"{out}: holds a training with {key} {before.get(key)}, now it is {now[key]}; "
                f"{cure}"
            )
        model.load_state_dict(content["model"])
        optimiser.load_state_dict(content["optimiser"])
        step = int(content["step"])
    except _FOREIGN as error:
        raise InputError(
            f"{out / STATE}: not the state of this training ({in_short(error)}); {cure}"
        ) from error
    cut_curves(out / CURVES, step)
    return step


def cut_curves(path: Path, step: int) -> None:
    """Leave in losses.csv what was before a step, at which a training goes on; 0: begin the file.

    Raises:
        InputError: the file is missing or broken.
    """
    lines = list(read_lines(path, "choose another --out or delete it"))[1:] if step else []
    rows = [(line, whole_number(line.split(",")[0], f"{path}:{k}")) for k, line in lines]
    kept = [CURVES_HEAD, *(line for line, of in rows if of < step)]
    with whole_file(path) as temporary:
        temporary.write_text("\n".join(kept) + "\n", encoding="utf-8")


def _comparable(config: TrainingConfig) -> dict[str, str]:
    return {key: str(value) for key, value in asdict(config).items()}
