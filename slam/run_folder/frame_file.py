"""frames.csv: a line a frame, written while a run goes on, and read back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_table
from bmask_slam.tracking.results import FrameResult

FRAMES = "frames.csv"
STAGES = ("features", "moving", "tracking", "keyframe", "graph", "loops", "semantics")
COLUMNS = (
    *("index", "timestamp", "status", "segment", "matches", "inliers"),
    *("ignored", "mostly_moving"),
    *(f"{stage}_ms" for stage in STAGES),
    *("keyframe", "keyframe_reason"),
)

_NEEDED = ("index", "timestamp", "status", "keyframe")


@dataclass(frozen=True, eq=False)
class FrameTable:
    """The frames that a run processed, N of them; the fields are those of `FrameResult`.

    Attributes:
        index: (N,), position in the sequence; a live run counts the frames that it tracked.
        timestamps_s: (N,).
        status: N names of `TrackingStatus`.
        segment: (N,), number of the map segment.
        matches, inliers, ignored: (N,), numbers of features.
        mostly_moving: (N,).
        keyframe_ids: (N,), -1 for a frame that is no keyframe.
        keyframe_reasons: N texts, "" for a frame that is no keyframe.
        stage_ms: by the stage's name (N,), NaN where a frame did not pass the stage.
    """

    index: Ints
    timestamps_s: Array
    status: tuple[str, ...]
    segment: Ints
    matches: Ints
    inliers: Ints
    ignored: Ints
    mostly_moving: Mask
    keyframe_ids: Ints
    keyframe_reasons: tuple[str, ...]
    stage_ms: dict[str, Array]

    def __len__(self) -> int:
        return len(self.index)


def frame_row(result: FrameResult) -> dict[str, object]:
    """The values of a frame's line by column."""
    row: dict[str, object] = {
        "index": result.index,
        "timestamp": f"{result.timestamp_s:.6f}",
        "status": result.status.value,
        "segment": result.segment,
        "matches": result.matches,
        "inliers": result.inliers,
        "ignored": result.ignored,
        "mostly_moving": int(result.mostly_moving),
        "keyframe": "" if result.keyframe_id is None else result.keyframe_id,
        "keyframe_reason": result.keyframe_reason,
    }
    return row | {f"{stage}_ms": f"{ms:.3f}" for stage, ms in result.stage_ms.items()}


def read_frames(path: Path) -> FrameTable:
    """Read a frames.csv; a last line that was cut off is ignored.

    Raises:
        InputError: no such file, a column that is missing, or a value that is no number.
    """
    columns = read_table(path, _NEEDED, "run again", growing=True)
    absent = ("",) * len(columns["index"])  # a column that older versions did not write
    try:
        return _table({name: columns.get(name, absent) for name in COLUMNS})
    except (ValueError, OverflowError) as error:
        raise InputError(f"{path}: {error}; run again") from error


def _table(columns: dict[str, tuple[str, ...]]) -> FrameTable:
    def numbers(name: str, empty: float, kind: Callable[[str], Any] = int) -> Any:
        values = [kind(text) if text else empty for text in columns[name]]
        return np.array(values, float if kind is float else np.int64)

    return FrameTable(
        index=numbers("index", -1),
        timestamps_s=numbers("timestamp", np.nan, float),
        status=columns["status"],
        segment=numbers("segment", 0),
        matches=numbers("matches", 0),
        inliers=numbers("inliers", 0),
        ignored=numbers("ignored", 0),
        mostly_moving=numbers("mostly_moving", 0).astype(bool),
        keyframe_ids=numbers("keyframe", -1),
        keyframe_reasons=columns["keyframe_reason"],
        stage_ms={stage: numbers(f"{stage}_ms", np.nan, float) for stage in STAGES},
    )
