"""The path of a run beside a reference: its errors, and pictures of both."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from bmask_slam.evaluation import evaluate_trajectory, read_reference
from bmask_slam.evaluation.plot import draw_errors, draw_events, draw_top_view
from bmask_slam.evaluation.reference import reference_file
from bmask_slam.events import Event
from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.metrics import absolute_error
from bmask_slam.graph.trajectory import Trajectory, associate
from bmask_slam.reporting.drawing import as_picture, figure
from bmask_slam.reporting.parts import Picture
from bmask_slam.run_folder.reader import Metric, Run

logger = logging.getLogger(__name__)

WIDTH_IN, HIGH_IN = 4.4, 4.2
MIN_POSES = 3
ERRORS = ("ate_", "rpe_", "drift_")


def find_reference(run: Run, given: Path | None) -> Trajectory | None:
    """The given reference, or that of the run's sequence; None if that has none.

    Raises:
        InputError: the given one is missing or broken.
    """
    if given is not None:
        return read_reference(given)
    try:
        return None if run.sequence is None else read_reference(run.sequence)
    except InputError as error:  # a sequence without one, or one that was moved
        logger.info("no reference: %s", error)
        return None


def with_errors(
    metrics: Mapping[str, Metric],
    trajectory: Trajectory | None,
    reference: Trajectory,
    files: tuple[Path, Path],
) -> dict[str, Metric]:
    """The figures of a run with the errors of its trajectory against a given reference.

    ``files`` are those of both, for messages.

    Errors of its metrics.json, against another one, are left out; without a pose there are none.

    Raises:
        InputError: as `bmask_slam.evaluation.evaluate`, such as one without common times.
    """
    kept = {name: metric for name, metric in metrics.items() if not name.startswith(ERRORS)}
    if not trajectory:
        return kept
    with naming(f"{files[0]} against {reference_file(files[1])}"):
        rows = evaluate_trajectory(trajectory, reference).rows
    return {row["name"]: Metric(row["value"], row["unit"]) for row in rows} | kept


def path_pictures(
    trajectory: Trajectory, events: Sequence[Event], reference: Trajectory | None
) -> list[Picture]:
    """The path from above with events; with a reference aligned to it, and the errors."""
    if not len(trajectory):
        return []
    matched, truth = (trajectory, None) if reference is None else associate(trajectory, reference)
    if truth is None or len(truth) < MIN_POSES:
        caption = "The path in the plane in which the camera moved most, in the run's world frame."
        return [_path_picture(trajectory, events, None, None, caption)]
    error = absolute_error(matched, truth)
    rmse_mm = 1000 * error.translation_m.rmse
    caption = f"Aligned with the reference by SE(3): ATE {rmse_mm:.1f} mm over {len(truth)} poses."
    aligned = error.alignment.apply(trajectory)
    found = [_path_picture(aligned, events, reference, (error.aligned, truth), caption)]
    with figure(WIDTH_IN, HIGH_IN) as drawn:
        draw_errors(list(drawn.subplots(2, 1)), error)
        caption = "Translation and rotation error of each pose after the alignment."
        return [*found, as_picture(drawn, "Errors over time", caption)]


def _path_picture(
    shown: Trajectory,
    events: Sequence[Event],
    reference: Trajectory | None,
    ends: tuple[Trajectory, Trajectory] | None,
    caption: str,
) -> Picture:
    with figure(WIDTH_IN, HIGH_IN) as drawn:
        axes = drawn.add_subplot()
        draw_top_view(axes, shown, reference, ends)
        draw_events(axes, events, shown, reference)
        return as_picture(drawn, "The camera's path", caption)
