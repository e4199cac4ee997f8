"""Error figures of a comparison: trajectory against truth, RPE over time (paper Figs. 10, 11)."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from bmask_slam.comparison.experiment.result import Cell, CellStatus, Comparison, Method
from bmask_slam.comparison.jobs.errors import Rules
from bmask_slam.comparison.report.table import ATE, values
from bmask_slam.evaluation import evaluate_trajectory, read_reference
from bmask_slam.evaluation.plot import draw_top_view
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.metrics import AbsoluteError, RelativeError
from bmask_slam.graph.trajectory import MAX_TIME_DIFFERENCE_S, Trajectory, associate
from bmask_slam.graph.trajectory_formats import read_trajectory
from bmask_slam.reporting.drawing import as_picture, figure
from bmask_slam.reporting.parts import Picture

MAX_DIFFERENCES = 300
VISIBLE_SHARE = 0.04  # of the path's extent, for an RMSE
ENLARGED = (1, 2, 5, 10, 20, 50, 100)
WIDTH_IN, HEIGHT_IN = 4.4, 5.0
LEGEND_ROOM = 1.3
RPE_COLOUR = "#1f5fa8"

logger = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Errors:
    """The errors of one cell's trajectory, and the trajectories for the drawing.

    Attributes:
        cell: of the trajectory.
        aligned: the whole estimate in the reference's world frame.
        reference: the truth.
        absolute: of the associated poses.
        truth: the reference's poses that are associated with those of ``absolute``.
        per_second: relative error over a second; None if no poses are that far apart.
    """

    cell: Cell
    aligned: Trajectory
    reference: Trajectory
    absolute: AbsoluteError
    truth: Trajectory
    per_second: RelativeError | None


@dataclass(frozen=True)
class Scales:
    """Common scales of the figures of a sequence.

    Attributes:
        top_cm: end of the axes of relative errors.
        enlarged: factor by which differences between the paths are enlarged.
    """

    top_cm: float
    enlarged: int


def error_pictures(comparison: Comparison, sequence: str, folder: Path) -> list[Picture]:
    """A picture for each method that has a trajectory of the sequence, all in the same scales.

    The seed with the median ATE is drawn.
    """
    found = [
        (method, errors)
        for method in comparison.methods
        if (errors := _median_errors(comparison, sequence, method, folder)) is not None
    ]
    scales = common_scales([errors for _, errors in found])
    return [error_picture(method, errors, scales) for method, errors in found]


def common_scales(found: list[Errors]) -> Scales:
    """Axes for all errors, and the factor that makes the largest RMSE visible."""
    maxima_cm = [100 * e.per_second.translation_m.max for e in found if e.per_second is not None]
    ratios = [
        VISIBLE_SHARE
        * np.ptp(e.truth.positions_world, axis=0).max()
        / e.absolute.translation_m.rmse
        for e in found
        if e.absolute.translation_m.rmse > 0
    ]
    fitting = [factor for factor in ENLARGED if factor <= min(ratios, default=1)]
    top_cm = max(maxima_cm, default=0.0) or 1.0  # an axis of length 0 cannot be drawn
    return Scales(LEGEND_ROOM * top_cm, max(fitting, default=1))


def error_picture(method: Method, errors: Errors, scales: Scales) -> Picture:
    """Top view with the differences drawn, and the relative error over time below it."""
    with figure(WIDTH_IN, HEIGHT_IN) as drawn:
        path_axes, rpe_axes = drawn.subplots(2, 1, height_ratios=(2.1, 1))
        step = draw_path(path_axes, errors, scales.enlarged)
        draw_relative(rpe_axes, errors, scales.top_cm)
    cell = errors.cell
    seed = f", seed {cell.seed}" if cell.seed is not None else ""
    scale = ", aligned with scale" if method.with_scale else ""
    larger = f", enlarged {scales.enlarged} times" if scales.enlarged > 1 else ""
    caption = (
        f"{method.name}{seed}: ATE {100 * errors.absolute.translation_m.rmse:.2f} cm over "
        f"{len(errors.truth)} poses{scale}; {'each' if step == 1 else f'1 in {step}'} of the "
        f"differences drawn{larger}. Below: relative translation error over a second."
    )
    title = f"{method.name} on {cell.sequence}"
    return as_picture(drawn, title, caption, for_paper=True)


def draw_path(axes: Axes, errors: Errors, enlarged: int) -> int:
    """Draw estimate, reference and at most 300 differences; returns the step between those."""
    step = -(-len(errors.truth) // MAX_DIFFERENCES)
    every = np.arange(0, len(errors.truth), step)
    truth, estimate = errors.truth.select(every), errors.absolute.aligned.select(every)
    poses = truth.poses_world_camera.copy()
    poses[:, :3, 3] += enlarged * (estimate.positions_world - truth.positions_world)
    ends = (Trajectory(truth.timestamps_s, poses), truth)
    name = "difference" if enlarged == 1 else f"difference × {enlarged}"
    draw_top_view(axes, errors.aligned, errors.reference, ends, name)
    return step


def draw_relative(axes: Axes, errors: Errors, top_cm: float) -> None:
    """Draw the relative translation error over a second in cm against time, and its RMSE."""
    axes.set_xlabel("time (s)")
    axes.set_ylabel("RPE a second (cm)")
    axes.set_ylim(0, top_cm)
    axes.grid()
    if errors.per_second is None:
        return
    stamps_s = errors.per_second.timestamps_s
    error_cm = 100 * errors.per_second.translation_m.errors
    axes.plot(
        stamps_s - errors.absolute.aligned.timestamps_s[0], error_cm, color=RPE_COLOUR, lw=0.7
    )
    rmse_cm = 100 * errors.per_second.translation_m.rmse
    axes.axhline(rmse_cm, color="black", lw=0.7, ls="--", label=f"RMSE {rmse_cm:.2f} cm")
    axes.legend(loc="upper right")


def read_errors(cell: Cell, folder: Path, rules: Rules) -> Errors | None:
    """The errors of a cell's trajectory; None, with a warning, if there are none."""
    if cell.status is not CellStatus.DONE or not cell.trajectory or not cell.reference:
        return None
    largest_s = rules.max_time_difference_s
    try:
        estimate = read_trajectory(folder / cell.trajectory)
        reference = read_reference(folder / cell.reference)
        result = evaluate_trajectory(estimate, reference, None, rules.with_scale, largest_s)
    except InputError as error:
        logger.warning("no error figure: %s", error)
        return None
    truth = associate(estimate, reference, largest_s)[1]
    aligned = result.absolute.alignment.apply(estimate)
    return Errors(cell, aligned, reference, result.absolute, truth, result.per_second)


def stated_rules(comparison: Comparison, method: Method) -> Rules:
    """How a method's trajectories were compared."""
    experiment = comparison.provenance.get("experiment") or {}
    largest_s = experiment.get("max_time_difference_s", MAX_TIME_DIFFERENCE_S)
    return Rules(float(largest_s), method.with_scale)


def _median_errors(
    comparison: Comparison, sequence: str, method: Method, folder: Path
) -> Errors | None:
    """The errors of a method's cell with the median ATE; None if it cannot be drawn."""
    cells = sorted(_measured(comparison, sequence, method), key=lambda c: values([c], ATE))
    rules = stated_rules(comparison, method)
    return read_errors(cells[(len(cells) - 1) // 2], folder, rules) if cells else None


def _measured(comparison: Comparison, sequence: str, method: Method) -> Iterator[Cell]:
    return (c for c in comparison.of(sequence, method.name) if c.trajectory and values([c], ATE))
