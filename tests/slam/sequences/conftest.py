"""A tiny sequence in TUM layout with the frame number in the pixels."""

from pathlib import Path

import cv2
import numpy as np
import pytest

CAMERA = "{width: 32, height: 24, fx: 30, fy: 31, cx: 15, cy: 12, depth_scale: 1000, fps: 10}\n"


def make_sequence(folder: Path) -> Path:
    """Frame k: red is 10 k, green 20, blue 200; depth is (k + 1) * 100 but 0 in the first row."""
    (folder / "rgb").mkdir(parents=True)
    (folder / "depth").mkdir()
    lists = {"rgb": ["# timestamp file"], "depth": []}
    for k in range(12):
        bgr = np.full((24, 32, 3), (200, 20, 10 * k), np.uint8)
        depth = np.full((24, 32), (k + 1) * 100, np.uint16)
        depth[0] = 0
        cv2.imwrite(str(folder / f"rgb/{k}.png"), bgr)
        cv2.imwrite(str(folder / f"depth/{k}.png"), depth)
        lists["rgb"].append(f"{k / 10:.6f} rgb/{k}.png")
        lists["depth"].append(f"{k / 10 + 0.004:.6f} depth/{k}.png")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


@pytest.fixture
def folder(tmp_path) -> Path:
    return make_sequence(tmp_path / "seq")
