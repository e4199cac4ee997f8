# ruff: noqa: E501
"""Draws data_flow.svg, the picture in docs/architecture.md: ``python docs/images/data_flow.py``."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch

COLOURS = {
    "file": "#f3efe6",
    "slam": "#e3ecf7",
    "graph": "#fbe5d6",
    "semantics": "#e4f2e2",
    "mapping": "#efe4f5",
}
EDGE, TEXT, ARROW = "#5b6570", "#16202a", "#3d4852"
BOXES = {
    # name: (x, y, width, height, colour, title, text)
    "recording": (0.0, 6.3, 2.1, 1.25, "file", "recording, camera", "colour, depth,\ncamera.yaml"),
    "frame": (2.7, 6.3, 2.1, 1.25, "slam", "sequences/", "Frame: rgb,\ndepth in m, stamp"),
    "features": (5.4, 6.3, 2.1, 1.25, "slam", "features/", "BRISK corners with\ndepth, undistorted"),
    "moving": (8.1, 6.3, 2.1, 1.25, "slam", "moving/", "leaves out what\nmoves"),
    "tracking": (10.8, 6.3, 2.3, 1.25, "slam", "tracking/", "matches the local map,\noptimises the pose"),
    "result": (13.7, 6.3, 2.1, 1.25, "slam", "FrameResult", "OK, WEAK or LOST,\nT_world_camera"),
    "world": (10.8, 3.7, 2.3, 1.25, "slam", "world/", "the map: keyframes,\nlandmarks, who sees what"),
    "back_end": (7.9, 3.7, 2.3, 1.25, "slam", "back_end/", "landmarks made, fused,\nculled; factors chosen"),
    "graph": (5.2, 3.7, 2.1, 1.25, "graph", "graph/smoother", "factors, iSAM2:\nposes and points"),
    "loops": (7.9, 1.75, 2.3, 1.15, "slam", "loops/", "recognise, verify,\nconfirm"),
    "segmenter": (0.0, 3.7, 2.1, 1.25, "semantics", "segmenters/", "instances: mask,\nclasses, quality"),
    "labelling": (2.7, 3.7, 2.0, 1.25, "slam", "labelling/", "masks meet the\nlandmarks in view"),
    "beliefs": (2.7, 1.75, 2.0, 1.15, "semantics", "beliefs/, objects/", "labels of landmarks,\nobjects in space"),
    "dense": (13.7, 3.7, 2.1, 1.25, "mapping", "dense/, mapping/", "depth fused with\nneighbours: submaps"),
    "files": (0.0, -0.35, 15.8, 1.1, "file", "run_folder/",
              "trajectory.txt   keyframes.txt   frames.csv   landmarks.ply   graph   map   "
              "labels.csv   objects.json   dense/   metrics.json   log.txt"),
}  # fmt: skip
LANES = (
    (5.95, 7.95, "every frame"),
    (1.45, 5.35, "every keyframe"),
)


def draw_box(axes: Axes, name: str) -> None:
    """One room: its name in bold, below it what it does."""
    x, y, width, height, colour, title, text = BOXES[name]
    patch = FancyBboxPatch(
        (x, y), width, height, boxstyle="round,pad=0,rounding_size=0.12",
        facecolor=COLOURS[colour], edgecolor=EDGE, linewidth=1.0,
    )  # fmt: skip
    axes.add_patch(patch)
    middle = x + width / 2
    axes.text(middle, y + height - 0.27, title, ha="center", va="center", weight="bold",
              fontsize=9, color=TEXT)  # fmt: skip
    axes.text(middle, y + (height - 0.4) / 2, text, ha="center", va="center", fontsize=8,
              color=TEXT, linespacing=1.25)  # fmt: skip


def arrow(
    axes: Axes, *points: tuple[float, float], text: str = "", at: tuple[float, float] = (0, 0)
) -> None:
    """A line through points with a head at the last; text stands at ``at``."""
    xs, ys = zip(*points[:-1], strict=True)
    axes.plot(xs, ys, color=ARROW, lw=1.1, solid_capstyle="round")
    axes.annotate("", points[-1], points[-2],
                  arrowprops={"arrowstyle": "-|>", "color": ARROW, "lw": 1.1,
                              "shrinkA": 0, "shrinkB": 0})  # fmt: skip
    if text:
        axes.text(*at, text, fontsize=7.5, color=ARROW, ha="center", va="center", style="italic")


def draw(axes: Axes) -> None:
    """All boxes and arrows."""
    for bottom, top, label in LANES:
        axes.axhspan(bottom, top, color="#f7f8f9", zorder=0)
        axes.text(-0.25, (bottom + top) / 2, label, rotation=90, ha="center", va="center",
                  fontsize=9, color=EDGE)  # fmt: skip
    for name in BOXES:
        draw_box(axes, name)
    row = 6.92
    for right_of, left_of in ((2.1, 2.7), (4.8, 5.4), (7.5, 8.1), (10.2, 10.8), (13.1, 13.7)):
        arrow(axes, (right_of, row), (left_of, row))
    arrow(axes, (11.35, 4.95), (11.35, 6.3), text="local map", at=(11.83, 5.3))
    arrow(axes, (12.5, 6.3), (12.5, 5.62), (9.4, 5.62), (9.4, 4.95), text="a keyframe",
          at=(9.95, 5.47))  # fmt: skip
    arrow(axes, (7.9, 4.5), (7.3, 4.5), text="factors", at=(7.6, 4.66))
    arrow(axes, (7.3, 4.1), (7.9, 4.1), text="poses,\npoints", at=(7.6, 3.83))
    arrow(axes, (10.2, 4.33), (10.8, 4.33))
    arrow(axes, (9.4, 3.7), (9.4, 2.9))
    arrow(axes, (8.7, 2.9), (8.7, 3.7), text="relative\nposes", at=(8.3, 3.3))
    arrow(axes, (13.1, 4.33), (13.7, 4.33), text="poses", at=(13.4, 4.49))
    arrow(axes, (3.75, 6.3), (3.75, 5.62), (1.05, 5.62), (1.05, 4.95), text="image of a keyframe",
          at=(2.35, 5.47))  # fmt: skip
    arrow(axes, (2.1, 4.33), (2.7, 4.33), text="masks", at=(2.4, 4.49))
    arrow(axes, (3.7, 3.7), (3.7, 2.9), text="votes", at=(4.0, 3.3))
    arrow(axes, (4.4, 4.95), (4.4, 5.8), (9.0, 5.8), (9.0, 6.3), text="masks of what can move",
          at=(6.4, 5.65))  # fmt: skip
    arrow(axes, (12.0, 3.7), (12.0, 0.75))
    arrow(axes, (14.75, 3.7), (14.75, 0.75))
    arrow(axes, (3.7, 1.75), (3.7, 0.75))
    arrow(axes, (15.8, 6.92), (16.05, 6.92), (16.05, 0.2), (15.8, 0.2))
    legend = (("slam/", "slam"), ("graph/", "graph"), ("semantics/", "semantics"),
              ("mapping/", "mapping"), ("files", "file"))  # fmt: skip
    for k, (label, colour) in enumerate(legend):
        x = 5.3 + 1.55 * k
        axes.add_patch(FancyBboxPatch((x, 8.3), 0.3, 0.22, boxstyle="round,pad=0.02",
                                      facecolor=COLOURS[colour], edgecolor=EDGE, lw=0.8))  # fmt: skip
        axes.text(x + 0.42, 8.41, label, fontsize=8.5, va="center", color=TEXT)


def main() -> None:
    """Write the picture beside this file."""
    mpl.rcParams.update({"svg.hashsalt": "data_flow", "font.family": "DejaVu Sans"})
    figure = Figure(figsize=(12.4, 7.0))
    axes = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    axes.set_xlim(-0.5, 16.3)
    axes.set_ylim(-0.6, 8.8)
    axes.axis("off")
    draw(axes)
    path = Path(__file__).with_suffix(".svg")
    figure.savefig(path, metadata={"Date": None}, facecolor="white")


if __name__ == "__main__":
    main()
