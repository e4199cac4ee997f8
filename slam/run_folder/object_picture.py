"""objects.png: landmarks by label and objects, from above."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.semantics.objects.boxes3d import EDGES, gravity_axes

UNKNOWN_COLOUR = "#c9c9c4"
_MIN_NAMED_M = 0.25


def draw_objects(
    path: Path, cloud: LandmarkCloud, found: MapObjects, trajectory: Trajectory
) -> None:
    """Draw the map along ``up_world``, in metres, and write the picture.

    Only larger objects get their id; the legend has the number of objects of each class.
    """
    assert cloud.labels is not None
    R_upright_world = gravity_axes(found.up_world).T
    figure = Figure(figsize=(11, 9), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    labels, points = cloud.labels.estimates.labels, cloud.points_world @ R_upright_world.T
    unknown = labels == 0
    x, y = points[:, 0], points[:, 1]
    axes.scatter(x[unknown], y[unknown], s=1.5, c=UNKNOWN_COLOUR, linewidths=0)
    colours = np.array([class_colour(k) / 255 for k in labels[~unknown].tolist()]).reshape(-1, 3)
    axes.scatter(x[~unknown], y[~unknown], s=3, c=0.85 * colours, linewidths=0)
    for o in found.objects:
        corners = (o.box.corners_world @ R_upright_world.T)[:, :2]
        colour = 0.7 * class_colour(o.label) / 255
        axes.add_collection(LineCollection(list(corners[EDGES]), colors=[colour], linewidths=0.8))
        if o.box.size_m.max() > _MIN_NAMED_M:
            text = f"{found.names.map_name(o.label)} {o.id}"
            axes.annotate(text, corners.mean(axis=0), fontsize=6, ha="center", color=0.6 * colour)
    path_points = trajectory.positions_world @ R_upright_world.T
    axes.plot(*path_points[:, :2].T, color="black", lw=0.9, label="camera")
    counts = Counter(o.label for o in found.objects)
    for label in sorted(counts, key=lambda k: (-counts[k], k)):
        name = f"{found.names.map_name(label)} ({counts[label]})"
        axes.plot([], [], "s", ms=5, color=0.8 * class_colour(label) / 255, label=name)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("m")
    axes.set_ylabel("m")
    axes.set_title(f"{len(found.objects)} objects, {int((~unknown).sum())} labelled landmarks")
    axes.legend(frameon=False, fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.savefig(path, format="png")
