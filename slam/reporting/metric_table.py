"""The metrics of a comparison: name, unit and direction of each."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """How a metric is printed.

    Attributes:
        name: as in metrics.json and `bmask_slam.comparison.experiment.result.Cell.metrics`.
        title: as a column's heading.
        unit: of the printed number.
        scale: printed = stored x scale.
        digits: after the point.
        lower_is_better: None if neither direction is better.
    """

    name: str
    title: str
    unit: str
    scale: float = 1.0
    digits: int = 2
    lower_is_better: bool | None = True


METRICS = (
    Metric("ate_rmse", "ATE", "cm", 100.0),
    Metric("ate_rot_rmse", "ATE rotation", "°"),
    Metric("rpe_trans_rmse_frame", "RPE a frame", "mm", 1000.0),
    Metric("rpe_rot_rmse_frame", "RPE a frame, rotation", "°", digits=3),
    Metric("rpe_trans_rmse_second", "RPE a second", "cm", 100.0),
    Metric("rpe_rot_rmse_second", "RPE a second, rotation", "°"),
    Metric("rpe_trans_rmse_metre", "RPE a metre", "cm", 100.0),
    Metric("rpe_rot_rmse_metre", "RPE a metre, rotation", "°"),
    Metric("drift_trans", "drift", "%", 100.0),
    Metric("drift_rot", "drift, rotation", "°/m"),
    Metric("tracked_share", "tracked", "%", 100.0, 1, lower_is_better=False),
    Metric("evaluated_share", "evaluated", "%", 100.0, 1, lower_is_better=None),
    Metric("tracking_ms_median", "time a frame, median", "ms", digits=1),
    Metric("tracking_ms_p95", "time a frame, 95 %", "ms", digits=1),
    Metric("frames_per_second", "frames/s", "Hz", digits=1, lower_is_better=False),
    Metric("peak_rss_mb", "memory", "MB", digits=0),
    Metric("loops_closed", "loops", "", digits=0, lower_is_better=None),
    Metric("label_accuracy", "landmarks labelled right", "%", 100.0, 1, lower_is_better=False),
    Metric("depth_rmse_ratio", "depth error of the sensor's", "1"),
)
BY_NAME = {metric.name: metric for metric in METRICS}
