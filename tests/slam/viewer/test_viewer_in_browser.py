"""``view RUN --serve`` in Chromium: the printed address shows map, image, masks and plots."""

from __future__ import annotations

import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import DRAWING, EXECUTABLE, chromium
from faults import LONG_S

from bmask_slam.cli import main
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.sequences.sequence import open_sequence

pytest.importorskip("rerun_cli")
pytestmark = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium: apt-get install chromium (.ci/run does)"
)
SIZE = 1280, 800
MAP, CAMERA, KEYFRAME = (0, 40, 760, 550), (770, 60, 1280, 290), (770, 330, 1280, 550)
"""x1, y1, x2, y2 of the views."""
GREEN, ORANGE, BLUE = (20, 200, 40), (240, 140, 0), (40, 60, 230)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.fixture
def shown(office: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A run and its sequence: keyframes became blue, other frames orange; a dense green wall."""
    run, sequence = tmp_path / "run", tmp_path / "office"
    shutil.copytree(office, sequence)
    arguments = ["--segmenter", "truth", "--calibrate", "off", "--out", str(run), "--quiet"]
    assert main(["run", str(sequence), *arguments]) == 0
    images = open_sequence(sequence).pairs.rgb_files
    keyframes = read_frames(run / "frames.csv").keyframe_ids >= 0
    assert keyframes.any()
    assert not keyframes[-1]  # which is what the camera's view shows at the end
    for file, is_keyframe in zip(images, keyframes, strict=True):
        image = np.full_like(cv2.imread(str(file)), (BLUE if is_keyframe else ORANGE)[::-1])
        cv2.imwrite(str(file), image)
    side = np.linspace(-0.75, 0.75, 250)  # at 6 mm its points, of 12 mm, cover it
    x, y = (values.ravel().astype(np.float32) for values in np.meshgrid(side, side))
    wall = dict(zip("xyz", (x, y, np.full_like(x, 3.0)), strict=True))
    colour = {
        name: np.full(x.shape, value, np.uint8)
        for name, value in zip(("red", "green", "blue"), GREEN, strict=True)
    }
    (run / "dense").mkdir()
    write_ply(run / "dense" / "cloud.ply", wall | colour)
    return run, sequence


@contextmanager
def viewed(run: Path, sequence: Path) -> Iterator[str]:
    """The address that the command prints, while it goes on; then it is ended by Ctrl-C."""
    port = free_port()
    command = [sys.executable, "-m", "bmask_slam", "view", str(run), "--serve", str(port)]
    process = subprocess.Popen(
        [*command, "--sequence", str(sequence)], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        found = re.fullmatch(r"in a browser: (http://127\.0\.0\.1:(\d+)\?url=\S+)  \(.*\)\n", line)
        assert found, line
        assert found[2] == str(port)
        yield found[1]
        assert process.poll() is None
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(LONG_S) == 130
        process.stdout.close()


def share_of(picture: Image, view: tuple[int, int, int, int], colour: tuple[int, ...]) -> float:
    """The share of a view's pixels (H, W, 3) that have about a colour."""
    x1, y1, x2, y2 = view
    off = np.abs(picture[y1:y2, x1:x2].astype(int) - colour).max(axis=2)
    return float((off < 45).mean())


def test_the_printed_address_shows_the_map_the_image_and_the_masks(
    shown: tuple[Path, Path], tmp_path: Path
) -> None:
    shot, shares = tmp_path / "viewer.png", [0.0]
    with viewed(*shown) as url, chromium(tmp_path / "profile", DRAWING) as browser:
        browser.go(url, *SIZE)
        end_s = time.monotonic() + LONG_S
        while min(shares) < 0.01 and time.monotonic() < end_s:
            time.sleep(0.5)
            browser.screenshot(shot)
            picture = cv2.cvtColor(cv2.imread(str(shot)), cv2.COLOR_BGR2RGB)
            wanted = ((MAP, GREEN), (CAMERA, ORANGE), (KEYFRAME, BLUE))
            shares = [share_of(picture, view, colour) for view, colour in wanted]
    assert min(shares) >= 0.01, f"green, orange and blue in their views: {shares}"
    plots = picture[560:770, :960]
    assert (plots.max(axis=2).astype(int) - plots.min(axis=2) > 60).mean() > 0.001
