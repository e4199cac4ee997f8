"""objects.png: a map from above, with its objects."""

from __future__ import annotations

import colorsys
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

UNKNOWN_COLOUR = "#c9c9c4"
LISTED = 45
"""Objects in the legend at most, as many as have room; objects.json has all."""
_GOLDEN = 0.61803398875


def distinct_colour(number: int) -> tuple[float, float, float]:
    """A colour, red first in 0..1; those of consecutive numbers are far apart."""
    lightness = (0.42, 0.55, 0.33)[number % 3]
    return colorsys.hls_to_rgb((0.03 + _GOLDEN * number) % 1.0, lightness, 0.75)


def draw_objects(
    path: Path, cloud: LandmarkCloud, found: MapObjects, trajectory: Trajectory
) -> None:
    """Draw the map along ``up_world``, in metres, and write the picture.

    Every object has a colour of its own, for its box, its landmarks and its name, which is the
    label and the id; the legend lists the largest with probability and size. Small ones are drawn
    last.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - loads slowly

    R_upright_world = gravity_axes(found.up_world).T
    figure = Figure(figsize=(13, 9), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    flat = (cloud.points_world @ R_upright_world.T)[:, :2]
    axes.scatter(flat[:, 0], flat[:, 1], s=1.5, c=UNKNOWN_COLOUR, linewidths=0)
    ordered = sorted(found.objects, key=lambda o: -o.box.volume_m3)
    for number, o in enumerate(ordered):
        own = flat[np.isin(cloud.ids, o.landmark_ids)]
        corners = (o.box.corners_world @ R_upright_world.T)[:, :2]
        text = _draw_object(axes, o, found.names.map_name(o.label), own, corners, number)
        if number < LISTED:
            axes.plot([], [], "s", ms=6, color=distinct_colour(number), label=text)
    if len(ordered) > LISTED:
        axes.plot([], [], " ", label=f"and {len(ordered) - LISTED} smaller ones: see objects.json")
    path_points = trajectory.positions_world @ R_upright_world.T
    axes.plot(*path_points[:, :2].T, color="black", lw=0.9, label="camera")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    axes.set_title(f"{len(found.objects)} objects from above, {len(cloud.ids)} landmarks")
    axes.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, format="png")


def _draw_object(
    axes: Axes, o: MapObject, label: str, points: Array, corners: Array, number: int
) -> str:
    """Draw one with its points (N, 2) and its box's corners (8, 2); its text for the legend."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415 - loads slowly

    colour, name = distinct_colour(number), f"{label} {o.id}"
    axes.scatter(points[:, 0], points[:, 1], s=5, color=colour, linewidths=0)
    axes.add_collection(LineCollection(list(corners[EDGES]), colors=[colour], linewidths=1.6))
    box = {"facecolor": "white", "alpha": 0.7, "pad": 0.8, "linewidth": 0}
    place = corners.mean(axis=0)
    axes.annotate(name, place, fontsize=9, ha="center", va="center", color=colour, bbox=box)
    long_m, short_m = np.sort(o.box.size_m[:2])[::-1]
    size = f"{long_m:.2f} x {short_m:.2f} x {o.box.size_m[2]:.2f} m"
    return f"{name}: {o.distribution[o.label]:.2f}, {size}"
