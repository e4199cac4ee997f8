"""Training losses and precision against recall of networks (the paper's Figs. 8 and 9)."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from bmask_slam.comparison.experiment.result import Comparison
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError, finite_number, whole_number
from bmask_slam.graph.files.reading import read_table
from bmask_slam.reporting.drawing import COLOURS, DASHES, as_picture, figure
from bmask_slam.reporting.parts import Picture

LOSSES, CURVES = "losses.csv", "precision_recall.csv"
TOTAL, MASKS = "total", "segm, by class score x MaskIoU"
SMOOTHING_STEPS = 50
SIZE_IN = (4.4, 3.2)
Curves = dict[str, Array]
"""(N, 2) abscissa and ordinate by name."""

logger = logging.getLogger(__name__)


def network_pictures(comparison: Comparison, folder: Path) -> list[Picture]:
    """Losses and precision-recall curves of the networks that the experiment names.

    The folder of each is written by ``bmask-slam train`` and ``evaluate-segmentation --curves``.
    """
    named = (comparison.provenance.get("experiment") or {}).get("networks") or {}
    folders = {str(name): folder / str(path) for name, path in named.items()}
    losses = _read_all(folders, LOSSES, read_losses, TOTAL)
    precision = _read_all(folders, CURVES, read_precision, MASKS)
    pictures = []
    if losses:
        text = f"Training loss, mean over {SMOOTHING_STEPS} steps."
        pictures.append(curve_picture("Loss", text, losses, ("step", "loss")))
    if precision:
        text = "Precision against recall at IoU 0.5, mean over classes."
        pictures.append(
            curve_picture("Precision and recall", text, precision, ("recall", "precision"))
        )
    return pictures


def curve_picture(title: str, caption: str, curves: Curves, names: tuple[str, str]) -> Picture:
    """Lines in one figure with a legend; a loss has a logarithmic axis, a share the axis 0 to 1."""
    with figure(*SIZE_IN) as drawn:
        axes = drawn.add_subplot()
        for k, (name, points) in enumerate(curves.items()):
            dashes = DASHES[k // len(COLOURS) % len(DASHES)]
            axes.plot(*points.T, dashes, color=COLOURS[k % len(COLOURS)], lw=1.2, label=name)
        axes.set(xlabel=names[0], ylabel=names[1])
        axes.set(yscale="log") if names[1] == "loss" else axes.set(xlim=(0, 1), ylim=(0, 1.02))
        axes.grid()
        axes.legend()
        return as_picture(drawn, title, caption, for_paper=True)


def read_losses(path: Path) -> Curves:
    """Each loss of a losses.csv, and their sum as "total", against the step, smoothed."""
    parts: dict[str, dict[int, float]] = defaultdict(dict)
    for step, loss, value in _rows(path, ("step", "loss", "value")):
        parts[loss][whole_number(step, str(path))] = finite_number(value, str(path))
    shared = set.intersection(*(set(part) for part in parts.values())) if parts else set()
    if len(parts) > 1 and shared:
        parts[TOTAL] = {step: sum(p[step] for p in parts.values()) for step in sorted(shared)}
    return {name: _smooth(np.array(sorted(part.items()), float)) for name, part in parts.items()}


def read_precision(path: Path) -> Curves:
    """Each curve of a precision_recall.csv, named by kind and ranking score."""
    points = defaultdict(list)
    for kind, ranked_by, *numbers in _rows(path, ("kind", "ranked_by", "recall", "precision")):
        point = [finite_number(number, str(path)) for number in numbers]
        points[f"{kind}, by {ranked_by}"].append(point)
    return {name: np.array(values) for name, values in points.items()}


def _rows(path: Path, names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """The values of these columns, line by line."""
    columns = read_table(path, names, "train again", growing=True)
    return zip(*(columns[name] for name in names), strict=True)


def _read_all(
    folders: dict[str, Path], file: str, read: Callable[[Path], Curves], preferred: str
) -> Curves:
    """All curves of a single network, or the preferred curve of each of several."""
    found: dict[str, Curves] = {}
    for name, folder in folders.items():
        if not (folder / file).exists():
            continue
        try:
            found[name] = read(folder / file)
        except InputError as error:
            logger.warning("%s; skipped", error)
    if len(found) == 1:
        return next(iter(found.values()))
    first = {name: next(iter(curves.values()), None) for name, curves in found.items()}
    chosen = {name: curves.get(preferred, first[name]) for name, curves in found.items()}
    return {name: points for name, points in chosen.items() if points is not None}


def _smooth(points: Array) -> Array:
    width = min(SMOOTHING_STEPS, len(points))
    mean = np.convolve(points[:, 1], np.full(width, 1 / width), mode="valid")
    return np.column_stack([points[width - 1 :, 0], mean])
