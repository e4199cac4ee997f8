"""Trajectory evaluation: errors, tables and the picture of a run."""

from bmask_slam.evaluation.ate_rpe import (
    EvaluationResult,
    Row,
    evaluate,
    evaluate_trajectory,
    format_json,
    format_table,
    frame_stamps,
)
from bmask_slam.evaluation.reference import read_reference

__all__ = [
    "EvaluationResult",
    "Row",
    "evaluate",
    "evaluate_trajectory",
    "format_json",
    "format_table",
    "frame_stamps",
    "read_reference",
]
