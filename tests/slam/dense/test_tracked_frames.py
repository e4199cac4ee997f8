"""Which frames a surface is made of."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bmask_slam.dense.surface import tracked_frames
from bmask_slam.graph.trajectory import Trajectory, write_tum


@pytest.mark.parametrize("dropped", [0, 2])
def test_frames_by_odometry_alone_are_left_out_by_their_stamps(
    tmp_path: Path, dropped: int
) -> None:
    """A live run counts its frames from 0, also where it dropped the first of the sequence."""
    sequence_s = 1305031910.765238 + np.arange(10) / 30
    stamps_s = sequence_s[dropped:]
    reckoned = sequence_s[[4, 5]]
    write_tum(
        tmp_path / "trajectory.txt", Trajectory(stamps_s, np.tile(np.eye(4), (10 - dropped, 1, 1)))
    )
    lines = [
        f"{k},{s:.6f},{'DEAD_RECKONING' if s in reckoned else 'OK'},"
        for k, s in enumerate(stamps_s)
    ]
    (tmp_path / "frames.csv").write_text(
        "index,timestamp,status,keyframe\n" + "\n".join(lines) + "\n"
    )
    run: Any = SimpleNamespace(path=tmp_path, sequence=SimpleNamespace(timestamps_s=sequence_s))
    assert [k for k, _ in tracked_frames(run)] == [k for k in range(dropped, 10) if k not in (4, 5)]
