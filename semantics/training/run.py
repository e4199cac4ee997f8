"""Training from files: the initial network, the data, and a plot of the losses."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.network.config import LIGHT
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.training.dataset import Dataset, JoinedDatasets, split
from bmask_slam.semantics.training.loop import CURVES, TrainingConfig, train
from bmask_slam.semantics.weights.checkpoints import (
    TrainedNetwork,
    load_mobilenet,
    load_network,
)
from bmask_slam.semantics.weights.light_weights import (
    LightNetwork,
    is_light,
    load_light,
    new_light,
)
from bmask_slam.semantics.weights.yolox_onnx import load_onnx

SMOOTHING_STEPS = 25
PER_CLASS = {
    "roi_heads.box_predictor.cls_score": 1,
    "roi_heads.box_predictor.bbox_pred": 4,
    "roi_heads.mask_predictor.mask_fcn_logits": 1,
    "roi_heads.maskiou_head.maskiou": 1,
}
"""Layers with outputs for each class, and the number of outputs a class."""
ONNX = ".onnx"
DETECTOR = "detector."
"""Beginning of the names of the light network's parameters that are never trained."""


@dataclass(frozen=True)
class Source:
    """Training images.

    Attributes:
        file, images: COCO file and the folder of its images.
        held_out: share of the images that is held out for testing.
        split_seed: seed of this split; None: the training's seed.
    """

    file: Path
    images: Path
    held_out: float = 0.0
    split_seed: int | None = None


@dataclass(frozen=True)
class TrainingRun:
    """What to train, on what.

    Attributes:
        data: sources of images; one that is listed twice is drawn twice as often.
        out: folder of the results.
        weights: to start from; None: the light network with new heads.
        backbone: the published YOLOX-Nano in ONNX, in place of the one that comes with the project;
            or weights of an ImageNet MobileNetV2, for a network on it.
        labels: label set, by name or file.
        freeze: beginnings of the names of parameters that are not trained.
        settings: other values of ``TrainingConfig``.
    """

    data: tuple[Source, ...]
    out: Path
    weights: Path | None = None
    backbone: Path | None = None
    labels: str = "coco"
    freeze: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)


def run_training(run: TrainingRun, progress: Callable[[int, int], None]) -> Path:
    """Train and draw the losses; returns the weights file.

    Raises:
        InputError: data, weights or options that do not go together.
    """
    for source in run.data:
        if not 0 <= source.held_out < 1:
            raise InputError(
                f"--held-out {source.held_out}: a share of the images, from 0 to below 1"
            )
    try:
        config = TrainingConfig(freeze=run.freeze, **run.settings)
    except ValueError as error:
        raise InputError(f"training: {error}") from error
    labels = read_label_set(run.labels)
    seeds = [config.seed if s.split_seed is None else s.split_seed for s in run.data]
    parts = [
        Dataset(split(read_coco(s.file), s.held_out, seed)[0], s.images, labels)
        for s, seed in zip(run.data, seeds, strict=True)
    ]
    network = _start(run, labels, config.seed)
    if isinstance(network, LightNetwork):
        config = replace(config, freeze=(*config.freeze, DETECTOR))
    weights = train(network, JoinedDatasets(parts), run.out, config, progress)
    draw_losses(run.out / CURVES, run.out / "losses.png")
    return weights


def _start(run: TrainingRun, labels: LabelSet, seed: int) -> TrainedNetwork | LightNetwork:
    """The initial network."""
    torch.manual_seed(seed)
    if run.weights is not None and not is_light(run.weights):
        return transferred(load_network(run.weights), labels)
    if run.weights is None and run.backbone is not None and run.backbone.suffix != ONNX:
        model = MaskRCNN(replace(LIGHT, classes=len(labels)))
        load_mobilenet(model, run.backbone)
        return TrainedNetwork(model, labels)
    if labels != read_label_set("coco"):
        raise InputError(
            f"--labels {run.labels}: the light network has COCO's classes; for others give "
            "--weights of a Mask R-CNN, or --backbone of an ImageNet MobileNetV2"
        )
    if run.weights is not None:
        return load_light(run.weights)
    return new_light(load_onnx(run.backbone) if run.backbone else None)


def transferred(network: TrainedNetwork, labels: LabelSet) -> TrainedNetwork:
    """The network with other labels and a MaskIoU head.

    Parameters that do not depend on the classes are copied; in layers that do, the rows of classes
    of the same name and of the background. New rows and a new MaskIoU head are random at first.
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


def draw_losses(curves: Path, picture: Path) -> None:
    """Each loss against the step, smoothed (the paper's Fig. 8)."""
    values: dict[str, list[tuple[int, float]]] = defaultdict(list)
    columns = read_table(curves, ("step", "loss", "value"), "train again", growing=True)
    for step, loss, value in zip(*(columns[n] for n in ("step", "loss", "value")), strict=True):
        values[loss].append((int(step), float(value)))
    figure = matplotlib.figure.Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    for name, points in values.items():
        step, value = np.array(points).T
        width = min(SMOOTHING_STEPS, len(step))
        smooth = np.convolve(value, np.full(width, 1 / width), mode="valid")
        axes.plot(step[width - 1 :], smooth, label=name)
    axes.set(xlabel="step", ylabel="loss", yscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
    with whole_file(picture) as temporary:
        figure.savefig(temporary, dpi=120)
