"""Drawings of a run's report: features and times over the frames."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from bmask_slam.graph.arrays import Array, Ints
from bmask_slam.reporting.drawing import COLOURS, as_picture, figure
from bmask_slam.reporting.parts import Picture
from bmask_slam.run_folder.frame_file import STAGES, FrameTable
from bmask_slam.tracking.results import TrackingStatus

WIDTH_IN, LOW_IN = 4.4, 3.0
MAX_BINS, TIME_BINS = 300, 60
STAGE_COLOURS = (*COLOURS[:6], "#8c8c86")
SHADES = {TrackingStatus.LOST: (COLOURS[1], 0.35), TrackingStatus.WEAK: (COLOURS[5], 0.3)}


def frame_pictures(frames: FrameTable) -> list[Picture]:
    """Matched features and the time of each stage against time; none of fewer than two frames."""
    return [feature_picture(frames), time_picture(frames)] if len(frames) > 1 else []


def feature_picture(frames: FrameTable) -> Picture:
    """Matches and inliers of each frame, the keyframes, and where tracking was weak or lost."""
    time_s = frames.timestamps_s - frames.timestamps_s[0]
    with figure(WIDTH_IN, LOW_IN) as drawn:
        axes = drawn.add_subplot()
        _shade_status(axes, frames, time_s)
        for name, counts, colour in (
            ("matches", frames.matches, "#a8a8a2"),
            ("inliers", frames.inliers, COLOURS[0]),
        ):
            axes.plot(*_binned(time_s, counts), color=colour, lw=0.9, label=name)
        made = time_s[frames.keyframe_ids >= 0]
        axes.plot(made, np.zeros(len(made)), "|", color="black", ms=5, label="keyframe")
        _time_axis(axes, time_s, "features")
        axes.legend(loc="upper right", ncols=2)
        caption = "Features matched with the map and those that agree on the pose."
        return as_picture(drawn, "Features of each frame", caption)


def time_picture(frames: FrameTable) -> Picture:
    """Milliseconds of the stages, one upon the other, mean over neighbouring frames."""
    time_s = frames.timestamps_s - frames.timestamps_s[0]
    stages = [stage for stage in STAGES if np.isfinite(frames.stage_ms[stage]).any()]
    spent = [_binned(time_s, np.nan_to_num(frames.stage_ms[stage]), TIME_BINS) for stage in stages]
    with figure(WIDTH_IN, LOW_IN) as drawn:
        axes = drawn.add_subplot()
        if spent:
            axes.stackplot(
                spent[0][0], *(ms for _, ms in spent), labels=stages, colors=STAGE_COLOURS, lw=0
            )
        interval_ms = 1000 * float(np.median(np.diff(frames.timestamps_s)))
        axes.axhline(interval_ms, color="black", ls="--", lw=0.8, label="camera's interval")
        _time_axis(axes, time_s, "ms a frame")
        axes.legend(loc="upper right", ncols=2)
        caption = (
            "Time of each stage, mean over neighbouring frames; "
            f"the camera gives a frame every {interval_ms:.0f} ms."
        )
        return as_picture(drawn, "Time of each stage", caption)


def _shade_status(axes: Axes, frames: FrameTable, time_s: Array) -> None:
    """Shade the times of frames whose status is not OK, one span for neighbours."""
    status = np.array(frames.status)
    step_s = float(np.median(np.diff(time_s)))
    for kind, (colour, alpha) in SHADES.items():
        inside = np.concatenate([[False], status == kind.value, [False]]).astype(int)
        begins, ends = np.flatnonzero(np.diff(inside) > 0), np.flatnonzero(np.diff(inside) < 0)
        for k, (begin, end) in enumerate(zip(begins.tolist(), ends.tolist(), strict=True)):
            span_s = time_s[begin] - step_s / 2, time_s[end - 1] + step_s / 2
            label = kind.value if not k else None
            axes.axvspan(*span_s, color=colour, alpha=alpha, lw=0, label=label)


def _time_axis(axes: Axes, time_s: Array, name: str) -> None:
    axes.set(xlabel="time (s)", ylabel=name, xlim=(0, max(float(time_s[-1]), 1e-3)))
    axes.set_ylim(0, 1.35 * axes.get_ylim()[1])  # room for the legend
    axes.grid()


def _binned(time_s: Array, values: Array | Ints, bins: int = MAX_BINS) -> tuple[Array, Array]:
    """Means of neighbouring frames, at most ``bins`` of them."""
    groups = np.array_split(np.arange(len(time_s)), min(len(time_s), bins))
    return (
        np.array([time_s[group].mean() for group in groups]),
        np.array([np.mean(values[group]) for group in groups], float),
    )
