"""YOLOX boxes from an ONNX file, on real photographs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from repository import shared

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.network.boxes import iou
from bmask_slam.semantics.network.yolox.selection import SelectionConfig
from bmask_slam.semantics.segmenters.yolox import YoloxConfig, YoloxDetector, letterbox

ONNX = "weights/yolox_nano.onnx"


@pytest.fixture(scope="module")
def small() -> YoloxDetector:
    """At 416 pixels alone."""
    return YoloxDetector(shared(ONNX), YoloxConfig(mirror=False, sizes_px=(416,)))


@pytest.fixture(scope="module")
def both() -> YoloxDetector:
    """At 416 and at 640 pixels."""
    return YoloxDetector(shared(ONNX), YoloxConfig(mirror=False, sizes_px=(416, 640)))


def test_the_letterbox_keeps_proportions() -> None:
    image = np.zeros((30, 60, 3), np.uint8)
    image[..., 0] = 200  # red
    blob, factor = letterbox(image, 416)
    assert factor == pytest.approx(416 / 60)
    assert blob.shape == (1, 3, 416, 416)
    assert blob[0, :, 100, 100].tolist() == [0, 0, 200]  # blue first
    assert blob[0, :, 300, 100].tolist() == [114, 114, 114]


def test_the_real_network_finds_large_objects_in_real_photographs(small: YoloxDetector) -> None:
    content = read_coco(shared("coco_excerpt/instances.json"))
    hits = total = 0
    for image in content.images[:12]:
        pixels = read_colour(shared("coco_excerpt/images") / image.file_name)
        found = small.detect(pixels, content.labels)
        torch.testing.assert_close(found.distributions.sum(1), torch.ones(len(found.boxes)))
        large = [o for o in image.objects if not o.crowd and o.mask().mean() > 0.05]
        for o in large:
            total += 1
            same = (found.labels == o.label) & (found.scores > 0.3)
            overlap = iou(torch.tensor([o.box]), found.boxes[same])
            hits += bool((overlap > 0.6).any())
    assert total > 10
    assert hits / total > 0.6


def test_with_the_mirror_image_a_mirrored_scene_has_the_mirrored_boxes() -> None:
    detector = YoloxDetector(shared(ONNX), YoloxConfig(SelectionConfig(min_score=0.2)))
    labels = read_label_set("coco")
    image = read_colour(sorted(shared("coco_excerpt/images").iterdir())[0])
    one = detector.detect(image, labels)
    other = detector.detect(np.ascontiguousarray(image[:, ::-1]), labels)
    assert len(one.boxes) > 0
    x1, y1, x2, y2 = other.boxes.unbind(1)
    width = image.shape[1]
    back = torch.stack([width - x2, y1, width - x1, y2], dim=1)
    torch.testing.assert_close(back, one.boxes, atol=0.01, rtol=1e-4)
    torch.testing.assert_close(other.scores, one.scores, atol=1e-4, rtol=1e-4)


def test_a_second_input_size_finds_more_small_objects(
    small: YoloxDetector, both: YoloxDetector
) -> None:
    content = read_coco(shared("coco_excerpt/instances.json"))
    hits = {small: 0, both: 0}
    for image in content.images[:8]:
        pixels = read_colour(shared("coco_excerpt/images") / image.file_name)
        objects = [o for o in image.objects if not o.crowd and o.mask().sum() < 48**2]
        for detector in hits:
            found = detector.detect(pixels, content.labels)
            for o in objects:
                same = (found.labels == o.label) & (found.scores > 0.2)
                overlap = iou(torch.tensor([o.box]), found.boxes[same])
                hits[detector] += bool((overlap > 0.5).any())
    assert hits[both] > hits[small]


def test_only_classes_of_the_label_set_are_found(both: YoloxDetector) -> None:
    image = read_colour(sorted(shared("coco_excerpt/images").iterdir())[0])
    assert len(both.detect(image, label_set(["drone"])).boxes) == 0
    paper = read_label_set("paper")
    assert paper.number("tv") == 18
    assert set(both.detect(image, paper).labels.tolist()) <= set(range(1, 24))


def test_other_files_are_refused(tmp_path: Path) -> None:
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(b"no network")
    with pytest.raises(InputError, match="cannot read it as ONNX"):
        YoloxDetector(bad)
    with pytest.raises(InputError, match="no such file"):
        YoloxDetector(tmp_path / "none.onnx")
    with pytest.raises(InputError, match="not a YOLOX network"):
        YoloxDetector(shared(ONNX), YoloxConfig(sizes_px=(100,)))
