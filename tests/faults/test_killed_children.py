"""Children of a live run are killed at random moments, and the server that forks them: every
tracked pose is on the disk.

``BMASK_SLAM_FAULT_SEEDS=20 pytest tests/faults`` tries more than the usual seed; every second
one has a dense map too.
"""

from __future__ import annotations

import os
import random
import signal
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path

import pytest
from faults import children

from bmask_slam.config.configuration import resolve
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.runtime.fork_server import server_pid
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system_config import SystemConfig

FRAMES = 40
SEEDS = range(int(os.environ.get("BMASK_SLAM_FAULT_SEEDS", "1")))
CONFIG = resolve(SystemConfig, None, ("semantics.segmenter.name=truth",))


def kills(seed: int) -> Iterator[tuple[int, str]]:
    """Frames before which a child is killed, and its name: each once, some of them again."""
    draw, names = random.Random(seed), ["map", "segmenter", "calibration", "server"]
    names += ["dense"] if has_dense(seed) else []
    for name in (*names, *draw.choices(names, k=draw.randrange(3))):
        yield draw.randrange(2, FRAMES), name


def has_dense(seed: int) -> bool:
    """Whether a run has a dense map."""
    return seed % 2 == 0


@pytest.mark.parametrize("seed", SEEDS)
def test_every_tracked_pose_is_saved(slow_office: Path, tmp_path: Path, seed: int) -> None:
    plan, before, memory = sorted(kills(seed)), children(), set(os.listdir("/dev/shm"))
    sequence, tracked = open_sequence(slow_office), []
    options = LiveOptions(
        tmp_path / "run",
        images=slow_office,
        dense=has_dense(seed),
        calibrate="report",
        straightens=True,
        interpolates=True,
    )
    with LiveSlam(sequence.camera, CONFIG, options) as slam:
        for frame in islice(sequence.frames(), FRAMES):
            for name in (name for at, name in plan if at == frame.index):
                with suppress(ProcessLookupError, KeyError):  # it has died, and none is there yet
                    pid = server_pid() if name == "server" else slam.processes()[name]
                    os.kill(pid or slam.processes()["map"], signal.SIGKILL)
            arrived = slam.track(frame.timestamp_s, frame.rgb, frame.depth_m, name=frame.name)
            if arrived.T_world_camera is not None:
                tracked.append(frame.timestamp_s)
            slam.catch_up(waiting=2)  # frames do not run ahead of a process that is started again
    files = (tmp_path / "run").glob("trajectory*.txt")
    saved = [stamp_s for path in files for stamp_s in read_tum(path).timestamps_s.tolist()]
    assert sorted(saved) == pytest.approx(tracked, abs=1e-6), plan
    assert len(tracked) > FRAMES / 4, plan
    assert (tmp_path / "run" / "map").is_file(), plan
    assert children() <= before, plan
    assert set(os.listdir("/dev/shm")) <= memory, plan
