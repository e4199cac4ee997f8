"""YOLOX-Nano in torch: against the published ONNX file, and its parts against their definitions."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from repository import shared

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.labels import label_set, read_label_set
from bmask_slam.semantics.network.yolox.layers import PooledContext, convolutions
from bmask_slam.semantics.network.yolox.network import STRIDES, YoloxNano, decode
from bmask_slam.semantics.network.yolox.selection import SelectionConfig, select, voted
from bmask_slam.semantics.weights.yolox_onnx import load_onnx

ONNX = "weights/yolox_nano.onnx"
PHOTOGRAPHS = "coco_excerpt/images"


@pytest.fixture(scope="module")
def network() -> YoloxNano:
    return load_onnx(shared(ONNX))


@pytest.mark.parametrize("image", ["photograph", "noise"])
def test_it_computes_what_the_published_file_computes(network: YoloxNano, image: str) -> None:
    if image == "photograph":
        pixels = cv2.resize(read_colour(sorted(shared(PHOTOGRAPHS).iterdir())[3]), (416, 416))
    else:
        pixels = np.random.default_rng(0).integers(0, 256, (416, 416, 3), np.uint8)
    published = cv2.dnn.readNetFromONNX(str(shared(ONNX)))
    published.setInput(cv2.dnn.blobFromImage(pixels, swapRB=True))
    expected = torch.from_numpy(published.forward())
    with torch.inference_mode():
        tensor = torch.from_numpy(pixels).permute(2, 0, 1)[None].float()
        found = network.detections(network.features(tensor))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@torch.inference_mode()
def test_features_of_a_rectangle_have_the_stated_shapes(network: YoloxNano) -> None:
    features = network.features(torch.zeros(2, 3, 64, 96))
    assert features.stem.shape == (2, 16, 32, 48)
    assert features.edges.shape == (2, 32, 16, 24)
    assert [tuple(level.shape) for level in features.levels] == [
        (2, 64, 8, 12), (2, 128, 4, 6), (2, 256, 2, 3)
    ]  # fmt: skip
    assert network.detections(features).shape == (2, 8 * 12 + 4 * 6 + 2 * 3, 85)


def test_an_image_is_put_at_the_upper_left_at_its_proportions(network: YoloxNano) -> None:
    image = torch.zeros(3, 240, 320, dtype=torch.uint8)
    image[0] = 200
    padded, factor = network.letterboxed(image)
    assert factor == 2
    assert padded.shape == (1, 3, 480, 640)
    padded, factor = network.letterboxed(image[:, :200], side_px=300)
    assert factor == 300 / 320
    assert padded.shape == (1, 3, 192, 320)
    assert padded[0, :, 100, 100].tolist() == pytest.approx([200, 0, 0])
    assert padded[0, :, 188, 100].tolist() == padded[0, :, 100, 310].tolist() == [114, 114, 114]


def test_decoding_equals_a_loop_over_cells() -> None:
    height, width = 64, 96
    cells = [(s, r, c) for s in STRIDES for r in range(height // s) for c in range(width // s)]
    output = torch.rand(len(cells), 7, generator=torch.Generator().manual_seed(0))
    boxes, probabilities = decode(output, (height, width))
    for k, (stride, row, column) in enumerate(cells):
        x, y, w, h, objectness = output[k, :5].tolist()
        u, v = (x + column) * stride, (y + row) * stride
        half = np.exp([w, h]) * stride / 2
        corners = [u - half[0], v - half[1], u + half[0], v + half[1]]
        assert boxes[k].tolist() == pytest.approx(corners, rel=1e-5)
        assert probabilities[k].tolist() == pytest.approx((objectness * output[k, 5:]).tolist())


def test_pooling_in_sequence_is_pooling_in_wider_windows() -> None:
    torch.manual_seed(0)
    layer = PooledContext(4)
    x = torch.randn(1, 4, 20, 15)
    with torch.inference_mode():
        narrow = layer.narrowed(x)
        wide = [torch.nn.functional.max_pool2d(narrow, n, 1, n // 2) for n in (5, 9, 13)]
        torch.testing.assert_close(layer(x), layer.joined(torch.cat([narrow, *wide], dim=1)))


def test_a_kept_box_is_the_mean_of_overlapping_boxes_of_its_class() -> None:
    boxes = torch.tensor([
        [0.0, 0.0, 100.0, 100.0],
        [0.0, 0.0, 110.0, 100.0],  # IoU 0.91 with the first
        [0.0, 0.0, 100.0, 98.0],  # of another class
        [0.0, 0.0, 100.0, 60.0],  # 0.6
    ])  # fmt: skip
    labels, scores = torch.tensor([1, 1, 2, 1]), torch.tensor([0.6, 0.2, 0.9, 0.5])
    found = voted(boxes, scores, labels, torch.tensor([2, 0]), 0.8)
    mean = 0.75 * boxes[0] + 0.25 * boxes[1]
    torch.testing.assert_close(found, torch.stack([boxes[2], mean]))


def test_selected_boxes_are_of_the_label_set_clipped_and_best_first() -> None:
    coco = read_label_set("coco").names[1:]
    labels = label_set(("drone", "cup", "person"))
    probabilities = torch.full((4, 80), 0.001)
    for row, name, score in ((0, "person", 0.5), (1, "cup", 0.8), (2, "dog", 0.9)):
        probabilities[row, coco.index(name)] = score
    probabilities[3, coco.index("cup")] = 0.7  # overlaps the other cup
    boxes = torch.tensor([[-5.0, 0, 50, 99], [10, 10, 30, 30], [0, 0, 9, 9], [10, 10, 30, 31]])
    found = select(boxes, probabilities, (80, 40), labels, SelectionConfig(min_score=0.1))
    assert found.labels.tolist() == [2, 3]
    assert found.scores.tolist() == pytest.approx([0.8, 0.5])
    assert found.boxes[1].tolist() == [0, 0, 40, 80]
    assert found.distributions.shape == (2, 4)
    assert found.distributions.sum(dim=1).tolist() == pytest.approx([1, 1])
    assert found.distributions[0].tolist() == pytest.approx([0.199, 0, 0.8, 0.001])


def test_distributions_are_not_negative_by_rounding() -> None:
    """Scores of classes may add up to more than 1; then nothing is left for the background."""
    probabilities = torch.rand((500, 80), generator=torch.Generator().manual_seed(4))
    at = torch.arange(500) * 20.0
    boxes = torch.stack([at, torch.zeros(500), at + 15, torch.full((500,), 15.0)], dim=1)
    config = SelectionConfig(max_count=500)
    found = select(boxes, probabilities, (20, 10_000), read_label_set("coco"), config)
    assert len(found.distributions) == 500
    assert (found.distributions >= 0).all()
    assert torch.allclose(found.distributions.sum(dim=1), torch.ones(500))


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_onnx(tmp_path / "none.onnx")
    bad = tmp_path / "bad.onnx"
    bad.write_bytes(shared(ONNX).read_bytes()[:-1000])
    with pytest.raises(InputError, match="not an ONNX file that can be read"):
        load_onnx(bad)
    bad.write_bytes(b"\x3a\x00")  # a model with an empty graph
    with pytest.raises(InputError, match="0 convolutions that are not those of YOLOX-Nano"):
        load_onnx(bad)


def onnx_field(number: int, content: bytes) -> bytes:
    """A field of a Protocol Buffers message, of less than 128 bytes."""
    return bytes([number << 3 | 2, len(content)]) + content


def test_as_many_convolutions_of_other_shapes_are_refused(tmp_path: Path) -> None:
    weight = b"\x08\x01\x10\x01" + onnx_field(8, b"w") + onnx_field(9, bytes(4))  # one float
    conv = b"".join(onnx_field(1, name) for name in (b"x", b"w", b"w")) + onnx_field(4, b"Conv")
    graph = onnx_field(5, weight) + onnx_field(1, conv) * len(convolutions(YoloxNano()))
    size = bytes([len(graph) & 127 | 128, len(graph) >> 7])
    bad = tmp_path / "other.onnx"
    bad.write_bytes(b"\x3a" + size + graph)
    with pytest.raises(InputError, match="convolutions that are not those of YOLOX-Nano"):
        load_onnx(bad)


def test_a_number_that_does_not_end_takes_no_minutes(tmp_path: Path) -> None:
    bad = tmp_path / "long.onnx"
    bad.write_bytes(b"\xff" * 500_000 + b"\x01")
    with pytest.raises(InputError, match="a number that does not end"):
        load_onnx(bad)
