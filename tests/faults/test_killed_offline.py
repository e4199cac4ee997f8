"""An offline run is killed at random moments and resumed: the same bytes as one that was not.

``BMASK_SLAM_FAULT_SEEDS=20 pytest tests/faults`` tries 20 seeds, each with up to three kills.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from faults import untimed_files
from repository import KITCHEN

from bmask_slam.offline.runner import RunOptions, resume, run
from bmask_slam.run_folder.folder import CHECKPOINT

FRAMES, EVERY = 16, 4
SEEDS = range(int(os.environ.get("BMASK_SLAM_FAULT_SEEDS", "1")))
OPTIONS = RunOptions(KITCHEN, max_frames=FRAMES, checkpoint_every=EVERY, quiet=True)
pytestmark = pytest.mark.skipif(not KITCHEN.is_dir(), reason="no ../shared/data/redkitchen here")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(replace(OPTIONS, out=tmp_path_factory.mktemp("whole") / "run")).folder


def kill_after_lines(words: list[str], frames: Path, lines: int, delay_s: float) -> bool:
    """Start the program and kill it soon after frames.csv has this many lines; whether it ran."""
    with subprocess.Popen([sys.executable, "-m", "bmask_slam", *words, "--quiet"]) as process:
        while process.poll() is None:
            if frames.exists() and frames.read_bytes().count(b"\n") >= lines:
                time.sleep(delay_s)
                break
            time.sleep(0.005)
        was_running = process.poll() is None
        process.kill()
    return was_running


@pytest.mark.parametrize("seed", SEEDS)
def test_the_real_program_on_real_frames(undisturbed: Path, tmp_path: Path, seed: int) -> None:
    draw, out = random.Random(seed), tmp_path / "out"
    begin = ["run", str(KITCHEN), "--max-frames", str(FRAMES), "--checkpoint-every", str(EVERY)]
    command = [*begin, "--segmenter", "none", "--out", str(out)]
    lines = sorted(draw.sample(range(2, FRAMES + 1), (2, 1, 3)[seed % 3]))
    for count in lines:
        if not kill_after_lines(command, out / "frames.csv", count, draw.uniform(0, 0.05)):
            break  # the last kill came after its end
        assert (out / CHECKPOINT).exists(), (seed, lines)
        command = ["run", "--resume", str(out)]
    resume(out, {"quiet": True})
    assert untimed_files(out) == untimed_files(undisturbed), (seed, lines)
