"""objects.png: a map from above, with its objects."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.semantics.objects.boxes3d import EDGES, gravity_axes
from bmask_slam.semantics.objects.publication import MapObject

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OBJECT_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7a5195")
"""By class, in turn: those of Okabe and Ito, which colour-blind readers can distinguish, and one
more."""
LANDMARK_COLOUR, CAMERA_COLOUR, INK = "#b4b4ae", "#1c1c1a", "#1c1c1a"
LISTED = 30
"""Objects in the legend at most, as many as have room; objects.json has all."""
SHOWN_QUANTILES = (0.01, 0.99)
"""Landmarks farther out than these are errors of depth: they do not widen the picture."""
MARGIN_M, LINE_M = 0.3, 0.045
BARS_M = (0.5, 1.0, 2.0, 5.0, 10.0)
SIZE_IN = (10.4, 7.0)
_GOLDEN = 0.61803398875


def distinct_colour(number: int) -> tuple[float, float, float]:
    """A colour, red first in 0..1; those of consecutive numbers are far apart."""
    lightness = (0.42, 0.55, 0.33)[number % 3]
    return colorsys.hls_to_rgb((0.03 + _GOLDEN * number) % 1.0, lightness, 0.75)


def draw_objects(
    path: Path, cloud: LandmarkCloud, found: MapObjects, trajectory: Trajectory
) -> None:
    """Draw the map along ``up_world``, in metres, and write the picture.

    A class has one colour, for the boxes, landmarks and names of its objects; a name is the label
    and the id. The legend lists the largest with probability and size. Small ones are drawn last.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - loads slowly

    from bmask_slam.evaluation.plot import path_with_gaps  # noqa: PLC0415 - loads matplotlib

    R_upright_world = gravity_axes(found.up_world).T
    figure = Figure(figsize=SIZE_IN, dpi=130, layout="constrained")
    axes = figure.add_subplot()
    flat = (cloud.points_world @ R_upright_world.T)[:, :2]
    walked = (trajectory.positions_world @ R_upright_world.T)[:, :2]
    line = (path_with_gaps(trajectory) @ R_upright_world.T)[:, :2]
    axes.scatter(flat[:, 0], flat[:, 1], s=2.2, c=LANDMARK_COLOUR, linewidths=0)
    axes.plot(*line.T, color=CAMERA_COLOUR, lw=1.2, label="camera", zorder=3)
    axes.plot(*walked[:1].T, "o", ms=5, color=CAMERA_COLOUR, zorder=3)
    ordered = sorted(found.objects, key=lambda o: -o.box.volume_m3)
    labels = sorted({o.label for o in ordered})
    corners = [(o.box.corners_world @ R_upright_world.T)[:, :2] for o in ordered]
    for number, (o, edges) in enumerate(zip(ordered, corners, strict=True)):
        own = flat[np.isin(cloud.ids, o.landmark_ids)]
        colour = OBJECT_COLOURS[labels.index(o.label) % len(OBJECT_COLOURS)]
        text = _draw_object(axes, o, found.names.map_name(o.label), own, edges, colour)
        if number < LISTED:
            axes.plot([], [], "s", ms=7, mfc="none", color=colour, label=text)
    if len(ordered) > LISTED:
        axes.plot([], [], " ", label=f"and {len(ordered) - LISTED} smaller ones: see objects.json")
    _frame(axes, [flat, walked, *corners])
    _write_names(axes, ordered, corners, found)
    axes.set_title(f"{len(found.objects)} objects from above, {len(cloud.ids)} landmarks")
    figure.legend(frameon=False, fontsize=9, loc="outside right upper")
    figure.savefig(path, format="png")


def _draw_object(
    axes: Axes, o: MapObject, label: str, points: Array, corners: Array, colour: str
) -> str:
    """Draw one with its points (N, 2) and its box's corners (8, 2); its text for the legend."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - loads slowly

    axes.scatter(points[:, 0], points[:, 1], s=5, color=colour, linewidths=0)
    axes.add_collection(LineCollection(list(corners[EDGES]), colors=[colour], linewidths=1.6))
    long_m, short_m = np.sort(o.box.size_m[:2])[::-1]
    size = f"{long_m:.2f} x {short_m:.2f} x {o.box.size_m[2]:.2f} m"
    return f"{label} {o.id}: {o.distribution[o.label]:.2f}, {size}"


def _frame(axes: Axes, shown: Sequence[Array]) -> None:
    """Limit the picture to what is shown, landmarks (N, 2) first, and give it a scale bar."""
    landmarks, *rest = shown
    parts = [np.quantile(landmarks, SHOWN_QUANTILES, axis=0)] if len(landmarks) else []
    parts += [part for part in rest if len(part)]
    around = np.concatenate(parts) if parts else np.zeros((1, 2))
    low, high = around.min(axis=0) - MARGIN_M, around.max(axis=0) + MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xticks=[], yticks=[])
    axes.set_aspect("equal")
    for side in axes.spines.values():
        side.set_visible(False)
    bar_m = max((m for m in BARS_M if m < (high[0] - low[0]) / 3), default=BARS_M[0])
    y_m = low[1] + MARGIN_M / 4
    axes.plot([low[0], low[0] + bar_m], [y_m, y_m], color=INK, lw=3, solid_capstyle="butt")
    axes.annotate(f" {bar_m:g} m", (low[0] + bar_m, y_m), fontsize=9, va="center")


def _write_names(
    axes: Axes, ordered: Sequence[MapObject], corners: Sequence[Array], found: MapObjects
) -> None:
    """Write the names at their objects, moved up or down where they would cover each other.

    Names stay below the title and in the picture.
    """
    low_m, high_m = axes.get_ylim()
    line_m = LINE_M * (high_m - low_m)
    taken: list[tuple[float, float, float]] = []
    for o, box in zip(reversed(ordered), reversed(corners), strict=True):
        name = f"{found.names.map_name(o.label)} {o.id}"
        x_m, y_m = box.mean(axis=0).tolist()
        half_m = 0.25 * line_m * len(name)
        for step in (0, 1, -1, 2, -2, 3, -3):
            free = y_m + step * line_m
            inside = not step or low_m + line_m / 2 < free < high_m - line_m / 2
            if inside and all(
                abs(free - y) >= line_m or abs(x_m - x) >= half_m + h for x, y, h in taken
            ):
                y_m = free
                break
        taken.append((x_m, y_m, half_m))
        axes.plot([x_m, x_m], [box.mean(axis=0)[1], y_m], color=INK, lw=0.5, zorder=4)
        white = {"facecolor": "white", "alpha": 0.8, "pad": 1.0, "linewidth": 0}
        axes.annotate(
            name, (x_m, y_m), fontsize=9, ha="center", va="center", color=INK, bbox=white, zorder=5
        )
