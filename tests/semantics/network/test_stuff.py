"""The head that gives every pixel a class: shapes, places, and the folding of its batch norms."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.network.yolox.network import YoloxNano
from bmask_slam.semantics.network.yolox.stuff import StuffHead, _detected
from bmask_slam.semantics.training.stuff import lovasz_softmax, with_norms, without_norms
from bmask_slam.semantics.training.stuff_images import IGNORED, Augmentation, augmented


@pytest.fixture(scope="module")
def detector() -> YoloxNano:
    torch.manual_seed(0)
    return YoloxNano().eval()


def test_a_cell_stands_for_eight_by_eight_pixels(detector: YoloxNano) -> None:
    head = StuffHead(5).eval()
    with torch.inference_mode():
        features = detector.features(torch.zeros(2, 3, 64, 96))
        found = head(features, detector.detections(features))
    assert found.shape == (2, 5, 8, 12)


def test_detections_are_put_back_at_their_cells(detector: YoloxNano) -> None:
    """Rows of the raw output are cells of stride 8, then 16, then 32, row by row."""
    rows = 8 * 12 + 4 * 6 + 2 * 3
    output = torch.full((1, rows, 85), 0.5)
    output[0, 8 * 12 + 2 * 6 + 5, 4 + 7] = 1.0  # stride 16, row 2, column 5, class 6
    maps = _detected(output, (8, 12))
    assert [tuple(m.shape) for m in maps] == [(1, 81, 8, 12), (1, 81, 4, 6), (1, 81, 2, 3)]
    assert torch.nonzero(maps[1]).tolist() == [[0, 7, 2, 5]]
    assert float(maps[1].max()) == 1.0


def test_folding_the_norms_changes_nothing(detector: YoloxNano) -> None:
    torch.manual_seed(1)
    head = with_norms(StuffHead(4)).train()
    with torch.no_grad():
        features = detector.features(torch.rand(4, 3, 64, 64) * 255)
        detections = detector.detections(features)
        for _ in range(3):
            head(features, detections)  # the norms learn their statistics
        expected = head.eval()(features, detections)
        folded = without_norms(head)
        found = folded(features, detections)
    assert folded.state_dict().keys() == StuffHead(4).state_dict().keys()
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


def test_the_lovasz_loss_of_certain_answers_is_one_minus_iou() -> None:
    """Where probabilities are 0 or 1 the extension equals the loss itself."""
    truth = torch.tensor([0, 0, 0, 1, 1, 2])
    answer = torch.tensor([0, 0, 1, 1, 2, 2])
    p = torch.nn.functional.one_hot(answer, 4).T.float()
    iou = (2 / 3 + 1 / 3 + 1 / 2) / 3
    assert float(lovasz_softmax(p, truth)) == pytest.approx(1 - iou)


def test_labels_follow_the_image_when_it_is_augmented() -> None:
    """An image whose colour is its class: piece and labels must agree away from borders."""
    labels = np.zeros((96, 128), np.uint8)
    labels[:, 64:] = 1
    labels[60:] = 2
    image = (labels[..., None] * 100).astype(np.uint8).repeat(3, axis=2)
    config = Augmentation((64, 96), turn_deg=10, light=0.0, grey=0.0, blur=0.0, noise=0.0)
    seen = set()
    for seed in range(8):
        piece, classes = augmented(image, labels, config, np.random.default_rng(seed))
        assert piece.shape == (64, 96, 3)
        known = classes != IGNORED
        agrees = np.abs(piece[..., 0].astype(int) - 100 * classes.astype(int)) <= 1
        assert agrees[known].mean() > 0.94
        seen.add(int(classes[10, 10]) < int(classes[10, 85]))
    assert len(seen) == 2  # mirrored and not


def test_label_set_has_the_39_classes() -> None:
    from bmask_slam.semantics.labels import read_label_set

    names = read_label_set("nyu40").names
    assert len(names) == 40
    assert (names[1], names[2], names[22]) == ("wall", "floor", "ceiling")
    assert label_set(("a",)).names[1] == "a"
