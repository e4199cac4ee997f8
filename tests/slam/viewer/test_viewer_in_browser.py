"""``--serve`` in a real Chromium: the printed address shows the map, the image, masks and plots."""

from __future__ import annotations

import socket
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import DRAWING, EXECUTABLE, chromium

from bmask_slam.graph.arrays import Image
from bmask_slam.graph.camera import Camera
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.options import ViewOptions
from bmask_slam.viewer.scene import Scene
from bmask_slam.viewer.shown import as_jpeg

pytest.importorskip("rerun_cli")
pytestmark = pytest.mark.skipif(
    EXECUTABLE is None, reason="no Chromium: apt-get install chromium (.ci/run does)"
)
SIZE = 1280, 800
MAP, CAMERA, KEYFRAME = (0, 40, 760, 550), (770, 60, 1280, 290), (770, 330, 1280, 550)
"""x1, y1, x2, y2 of the views."""
DRAWN_S = 120.0
GREEN, ORANGE, BLUE = (20, 200, 40), (240, 140, 0), (40, 60, 230)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


def fill(scene: Scene) -> None:
    """A wall of green landmarks, an orange image, and a keyframe of blue with a mask on it."""
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    scene.log_camera(camera)
    scene.log_names(["unknown", "chair"])
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60)), -1).reshape(-1, 2)
    wall = np.column_stack([grid, np.full(len(grid), 3.0)])
    scene.set_time(0.0)
    scene.log_points("world/landmarks", wall, np.tile(np.uint8(GREEN), (len(wall), 1)), 0.02)
    images = [np.full((480, 640, 3), colour, np.uint8) for colour in (ORANGE, BLUE)]
    for k in range(12):
        T = np.eye(4)
        T[0, 3] = 0.05 * k
        times = {"tracking": 10.0 + k}
        scene.log_frame(
            FrameResult(k, k / 30, TrackingStatus.OK, T, information=1e4 * np.eye(6),
                        stage_ms=times), images[0]
        )  # fmt: skip
    mask = np.zeros((480, 640), bool)
    mask[100:300, 100:400] = True
    box, surely = np.array([100.0, 100, 400, 300]), np.array([0.1, 0.9])
    scene.log_masks(
        as_jpeg(images[1]), [Instance(mask, box, 1, surely, 0.9, 0.9)], ["unknown", "chair"]
    )


def share_of(picture: Image, view: tuple[int, int, int, int], colour: tuple[int, ...]) -> float:
    """The share of a view's pixels (H, W, 3) that have about a colour."""
    x1, y1, x2, y2 = view
    off = np.abs(picture[y1:y2, x1:x2].astype(int) - colour).max(axis=2)
    return float((off < 45).mean())


def test_the_address_shows_the_map_the_image_and_the_masks(tmp_path: Path) -> None:
    scene = Scene("browser", ViewOptions(serve=free_port()))
    try:
        fill(scene)
        assert scene.addresses == [f"in a browser: {scene.url}"]
        shot, shares = tmp_path / "viewer.png", [0.0]
        with chromium(tmp_path / "profile", DRAWING) as browser:
            browser.go(scene.url, *SIZE)
            end_s = time.monotonic() + DRAWN_S
            while min(shares) < 0.01 and time.monotonic() < end_s:
                time.sleep(0.5)
                browser.screenshot(shot)
                picture = cv2.cvtColor(cv2.imread(str(shot)), cv2.COLOR_BGR2RGB)
                wanted = ((MAP, GREEN), (CAMERA, ORANGE), (KEYFRAME, BLUE))
                shares = [share_of(picture, view, colour) for view, colour in wanted]
        assert min(shares) >= 0.01, f"green, orange and blue in their views: {shares}"
        plots = picture[560:770, :960]
        assert (plots.max(axis=2).astype(int) - plots.min(axis=2) > 60).mean() > 0.001
    finally:
        scene.close()
