"""``bmask-slam segment`` on a rendered sequence."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.graph.camera import Camera
from bmask_slam.rendering.annotations import CLASSES, coco, visible_instances


@pytest.fixture
def rendered(tmp_path: Path) -> Path:
    """A sequence of two small images, annotated as the renderer does it."""
    folder = tmp_path / "office"
    (folder / "rgb").mkdir(parents=True)
    instances = np.zeros((2, 24, 32), np.uint16)
    instances[:, 3:9, 4:20] = 1
    instances[0, 12:20, 10:18] = 2
    frames = [visible_instances(picture) for picture in instances]
    camera = Camera(32, 24, 30.0, 30.0, 15.5, 11.5)
    scene = SimpleNamespace(categories=["desk", "cup"])
    content = coco(frames, ["0.0", "0.1"], camera, scene)  # type: ignore[arg-type]
    (folder / "annotations.json").write_text(json.dumps(content))
    (folder / "rgb.txt").write_text("0.0 rgb/0.0.png\n0.1 rgb/0.1.png\n")
    for stamp in ("0.0", "0.1"):
        cv2.imwrite(str(folder / "rgb" / f"{stamp}.png"), np.full((24, 32, 3), 90, np.uint8))
    return folder


def test_the_truth_of_a_rendered_sequence(
    rendered: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "masks"
    assert main(["segment", str(rendered), "--segmenter", "truth", "--out", str(out)]) == 0
    assert "3 instances in 2 images, 0 of them reused" in capsys.readouterr().out
    made = json.loads((out / "annotations.json").read_text())
    names = [c["name"] for c in made["categories"]]
    found = {(names[a["category_id"] - 1], a["image_id"], a["area"]) for a in made["annotations"]}
    assert found == {("desk", 1, 96), ("cup", 1, 64), ("desk", 2, 96)}
    assert names == list(CLASSES)
    assert len(list((out / "overlays" / "rgb").iterdir())) == 2
    command = ["segment", str(rendered), "--segmenter", "truth", "--out", str(out), "--quiet"]
    assert main(command) == 0
    assert capsys.readouterr().out.strip() == str(out / "annotations.json")
    again = ["--segmenter", "precomputed", "--masks", str(out / "annotations.json")]
    assert main(["segment", str(rendered), *again, "--out", str(tmp_path / "b"), "--quiet"]) == 0
    copy = json.loads((tmp_path / "b" / "annotations.json").read_text())
    assert [a["segmentation"] for a in copy["annotations"]] == [
        a["segmentation"] for a in made["annotations"]
    ]


def test_a_folder_of_images_and_rejected_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "pictures"
    folder.mkdir()
    command = ["segment", str(folder), "--segmenter", "none", "--out", str(tmp_path / "m")]
    assert main(command) == 1
    assert "no image in it" in capsys.readouterr().err
    cv2.imwrite(str(folder / "a.jpg"), np.zeros((20, 30, 3), np.uint8))
    assert main(command) == 0
    assert "0 instances in 1 images" in capsys.readouterr().out
    network = ["--segmenter", "mask-scoring-rcnn"]
    assert main(["segment", str(folder), *network, "--out", str(tmp_path / "n")]) == 1
    assert "give --weights" in capsys.readouterr().err
