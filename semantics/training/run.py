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

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_table
from bmask_slam.graph.whole_file import whole_file
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.labels import LabelSet, read_label_set
from bmask_slam.semantics.network.config import LIGHT
from bmask_slam.semantics.network.model import MaskRCNN
from bmask_slam.semantics.training.dataset import Dataset, JoinedDatasets, split
from bmask_slam.semantics.training.loop import CURVES, TrainingConfig, train
from bmask_slam.semantics.training.transfer import transferred
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
        light: whether ``weights`` get the light network's anchors and numbers of proposals and
            detections.
        backbone: the published YOLOX-Nano in ONNX, in place of the one that comes with the project;
            or weights of an ImageNet MobileNetV2, for a network on it.
        labels: label set, by name or file.
        freeze: beginnings of the names of parameters that are not trained.
        settings: other values of ``TrainingConfig``.
    """

    data: tuple[Source, ...]
    out: Path
    weights: Path | None = None
    light: bool = False
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
        like = LIGHT if run.light else None
        return transferred(load_network(run.weights), labels, like)
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
