"""Trajectory evaluation: errors, tables and the picture of a run."""

from slam.evaluation.evaluation import (
    EvaluationResult,
    Row,
    evaluate,
    evaluate_trajectory,
    format_json,
    format_table,
    frame_stamps,
    read_reference,
)

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
