"""Lenses of more than five coefficients: what is undistorted lies where the pinhole has it."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from recorded_bags import BagMaker, camera_info, image

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.lens import distortion_terms
from bmask_slam.live.sources.bag_source import BagSource
from bmask_slam.live.sources.ros2_source import Ros2Options, Ros2Source
from bmask_slam.sequences.bags.bag_file import open_bag
from bmask_slam.sequences.cameras import write_camera
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import open_sequence

CAMERA = Camera(160, 120, 100.0, 101.0, 79.0, 60.5, depth_scale=1000.0)
LENSES = {
    "rational_polynomial": (-0.3, 0.1, 4e-4, -2e-4, 0.02, 0.1, -0.05, 0.02),
    "equidistant": (-0.05, 0.02, -0.01, 0.003),
}
POINTS = np.array([[0.0, 0, 2], [1.1, 0.7, 2], [-1.2, -0.8, 2], [-1.0, 0.9, 2], [1.2, -0.9, 2]])
"""In the camera's frame: blobs of 5x5 pixels, bright and with depth."""
T_COLOUR_DEPTH = np.eye(4)
T_COLOUR_DEPTH[:3, 3] = 0.2, 0.1, 0.0
RGB, DEPTH = "/rgb/image_raw", "/depth/image_raw"


def seen(points: np.ndarray, model: str) -> np.ndarray:
    """Pixels (N, 2), whole, where the lens has points; "" is none."""
    none, rows = np.zeros(3), points[:, None]
    terms = np.array(LENSES.get(model, (0.0,) * 5))
    project = cv2.fisheye.projectPoints if model == "equidistant" else cv2.projectPoints
    named = {"K": CAMERA.K, "D": terms} if model == "equidistant" else {}
    words = () if named else (CAMERA.K, terms)
    found = project(rows, none, none, *words, **named)[0]
    return found.reshape(-1, 2).round().astype(int)


def blobs(pixels: np.ndarray, values: np.ndarray) -> np.ndarray:
    """An image (H, W) with values about pixels, 0 elsewhere."""
    made = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    for (u, v), value in zip(pixels, values, strict=True):
        made[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3] = value
    return made


def info(model: str) -> Any:
    made = camera_info(LENSES[model])
    made.distortion_model, made.k = model, CAMERA.K.ravel()
    return made


def write(path: Path, model: str, registered: bool) -> Path:
    """Two frames of the points; depth in colour's image, or in that of a camera like it."""
    at_depth = POINTS if registered else POINTS - T_COLOUR_DEPTH[:3, 3]
    white = np.full(len(POINTS), 255)
    colour = np.repeat(blobs(seen(POINTS, model), white)[..., None], 3, axis=2).astype(np.uint8)
    stored = blobs(seen(at_depth, model), 1000 * POINTS[:, 2])
    with BagMaker(path) as bag:
        bag.write("/rgb/camera_info", 1.0, info(model), "rgb")
        bag.write("/depth/camera_info", 1.0, info(model), "depth")
        if not registered:
            bag.write_transform("/tf_static", T_COLOUR_DEPTH, ("rgb", "depth"))
        for k in range(2):
            bag.write(RGB, 1 + k / 30, image("rgb8", colour), "rgb")
            frame = "rgb" if registered else "depth"
            bag.write(DEPTH, 1 + k / 30, image("16UC1", stored), frame)
    return path


def check(frame: Frame, model: str = "") -> None:
    """Colour and depth are where the pinhole has the points, or the lens ``model``."""
    for u, v in seen(POINTS, model):
        assert frame.rgb[v, u].min() > 200
        assert frame.depth_m[v, u] == pytest.approx(2.0, abs=1e-3)


def test_the_lenses_are_not_for_nothing() -> None:
    for model in LENSES:
        assert np.abs(seen(POINTS, model) - seen(POINTS, "")).max() > 4


class Node:
    """A node of ROS 2 on which the messages of a bag are received again and again."""

    def __init__(self, path: Path) -> None:
        with open_bag(path) as bag:
            self._kinds = {topic.name: topic.type for topic in bag.topics}
            self._messages = list(bag.messages(*self._kinds))

    def published(self) -> dict[str, str]:
        return self._kinds

    def reader(self, topic: str, *_: Any) -> Any:
        node = self

        class Reader:
            broken = 0

            def take(self, _: int = 16) -> list[Any]:
                return [message for name, message in node._messages if name == topic]

        return Reader()


@pytest.mark.parametrize("registered", [True, False], ids=["registered", "of its own camera"])
@pytest.mark.parametrize("model", LENSES)
def test_images_of_a_lens_are_undistorted(model: str, registered: bool, tmp_path: Path) -> None:
    path = write(tmp_path / "a", model, registered)
    recorded, live = open_sequence(path), BagSource(path)
    heard = Ros2Source(Node(path), "ros2:0", Ros2Options(silence_s=1.0))  # type: ignore[arg-type]
    for frame, camera in (
        (recorded.load(1), recorded.camera),
        (next(live.frames()), live.camera),
        (next(heard.frames()), heard.camera),
    ):
        assert camera == CAMERA
        check(frame)


def test_the_camera_of_a_run_is_that_of_undistorted_images(tmp_path: Path, caplog) -> None:
    path = write(tmp_path / "a", "rational_polynomial", registered=True)
    again = open_sequence(path, camera=open_sequence(path).camera)  # as bmask-slam map does
    check(again.load(0))
    calibrated = replace(CAMERA, fx=100.5, distortion=(0.002, -0.001, 0.0, 0.0, 0.0))
    write_camera(tmp_path / "camera.yaml", calibrated)
    with caplog.at_level(logging.INFO):
        check(open_sequence(path, camera=tmp_path / "camera.yaml").load(0))
    assert "images are undistorted by the lens of /rgb/camera_info" in caplog.text


def test_a_given_camera_of_the_recorded_images_takes_them_as_they_are(tmp_path: Path) -> None:
    path = write(tmp_path / "a", "rational_polynomial", registered=True)
    rows, columns = np.mgrid[:120:5, :160:5]
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=-1)
    rays = CAMERA.backproject(pixels, np.ones(len(pixels)))
    terms = distortion_terms(rays[:, :2]).reshape(-1, 5)
    none = np.zeros(3)
    lens = np.array(LENSES["rational_polynomial"])
    bent = cv2.projectPoints(rays, none, none, np.eye(3), lens)[0][:, 0] - rays[:, :2]
    fitted = tuple(np.linalg.lstsq(terms, bent.ravel())[0].tolist())
    write_camera(tmp_path / "camera.yaml", replace(CAMERA, distortion=fitted))
    check(open_sequence(path, camera=tmp_path / "camera.yaml").load(0), "rational_polynomial")
