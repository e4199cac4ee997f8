"""COCO's figures: perfect masks, ranked well and badly, and the command on real photographs."""

from __future__ import annotations

import json
import weakref
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bmask_slam.cli import main
from bmask_slam.graph.arrays import Image
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances.coco_files import CocoFile, read_coco
from bmask_slam.semantics.instances.instances import Instance, as_annotation, certain, mask_box
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.evaluation import (
    draw_precision_recall,
    evaluate_segmenter,
    format_segmentation,
)
from bmask_slam.semantics.segmenters.segmenter import CocoSegmenter

LABELS = label_set(["cup", "mouse"])


def disc(x: int, y: int, radius: float) -> np.ndarray:
    v, u = np.mgrid[:90, :120]
    return np.asarray((u - x) ** 2 + (v - y) ** 2 < radius**2)


def instance(mask: np.ndarray, score: float, iou: float) -> Instance:
    return Instance(mask, mask_box(mask), 1, certain(1, 3, score), score, score * iou)


class Scripted:
    """Returns given instances."""

    labels = LABELS

    def __init__(self, found: list[Instance]) -> None:
        self._found = found

    def segment(self, image: Image, name: str) -> list[Instance]:
        return self._found


@pytest.fixture
def truth(tmp_path: Path) -> tuple[CocoFile, Path]:
    """One image with two cups, in a file with other class numbers."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((90, 120, 3), np.uint8))
    annotations = [
        {**as_annotation(instance(disc(x, 45, 20), 1, 1)), "image_id": 1, "category_id": 9}
        for x in (30, 85)
    ]
    content = {
        "images": [{"id": 1, "file_name": "a.png", "height": 90, "width": 120}],
        "categories": [{"id": 5, "name": "boat"}, {"id": 9, "name": "cup"}],
        "annotations": annotations,
    }
    (tmp_path / "truth.json").write_text(json.dumps(content))
    return read_coco(tmp_path / "truth.json"), tmp_path


def quiet(done: int, total: int) -> None:
    assert done <= total


def test_perfect_masks_have_ap_one_and_no_masks_zero(truth: tuple[CocoFile, Path]) -> None:
    perfect = [instance(disc(x, 45, 20), 0.9, 1.0) for x in (30, 85)]
    result = evaluate_segmenter(Scripted(perfect), *truth, quiet)
    assert [c.ap for c in result.curves] == pytest.approx([1, 1, 1])
    assert np.isnan(result.iou_correlation)  # two matches say nothing
    nothing = evaluate_segmenter(Scripted([]), *truth, quiet)
    assert [c.ap for c in nothing.curves] == [0, 0, 0]
    with pytest.raises(InputError, match="none of the data's classes"):
        evaluate_segmenter(Scripted.__new__(Other), *truth, quiet)


def test_images_of_another_size_than_their_annotations_are_refused(
    truth: tuple[CocoFile, Path],
) -> None:
    content, folder = truth
    (image,) = content.images
    other = replace(content, images=(replace(image, width=2 * image.width),))
    with pytest.raises(InputError, match=f"has {image.width}x.* its annotations {2 * image.width}"):
        evaluate_segmenter(Scripted([]), other, folder, quiet)


class Other(Scripted):
    labels = label_set(["drone"])


def test_a_good_mask_score_ranks_bad_masks_last(
    truth: tuple[CocoFile, Path], tmp_path: Path
) -> None:
    """A loose mask has the better class score, but its predicted IoU is low."""
    found = [
        instance(disc(30, 45, 28), 0.9, 0.5),  # IoU about 0.51, of the boxes as well
        instance(disc(30, 45, 20), 0.6, 1.0),
        instance(disc(85, 45, 24), 0.8, 0.7),
        instance(disc(85, 45, 20), 0.7, 0.95),
    ]
    result = evaluate_segmenter(Scripted(found), *truth, quiet)
    _, by_class, by_mask = result.curves
    assert by_mask.ap75 == pytest.approx(1)
    assert by_class.ap75 < 0.7
    assert by_mask.ap > by_class.ap + 0.1
    assert result.iou_correlation > 0.95
    assert result.iou_correlation_of_good == result.iou_correlation
    assert f"{by_mask.ap:.4f}" in format_segmentation(result)
    draw_precision_recall(result, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 1000


def test_masks_of_images_that_are_done_are_not_kept(truth: tuple[CocoFile, Path]) -> None:
    content, folder = truth
    kept: list[weakref.ref[Instance]] = []

    class Fresh:
        labels = LABELS

        def segment(self, image: Image, name: str) -> list[Instance]:
            assert not any(reference() for reference in kept[:-1])  # the last may still be named
            made = instance(disc(30, 45, 20), 0.9, 1.0)
            kept.append(weakref.ref(made))
            return [made]

    many = CocoFile(content.labels, content.category_ids, content.images * 4, content.problems)
    result = evaluate_segmenter(Fresh(), many, folder, quiet)
    assert result.instances == 4
    assert result.curves[0].ap == pytest.approx(0.5, abs=0.01)  # one of two cups in each


def test_the_correlation_counts_bad_masks_in_good_boxes(truth: tuple[CocoFile, Path]) -> None:
    ring = disc(30, 45, 20) & ~disc(30, 45, 16)  # the disc's box, a third of its area
    small = disc(85, 45, 5)  # not even the box
    found = [
        instance(disc(30, 45, 20), 0.9, 1.0),
        instance(disc(85, 45, 24), 0.8, 0.7),
        instance(disc(85, 45, 22), 0.8, 0.8),
        instance(ring, 0.7, 0.35),
        instance(small, 0.7, 1.0),
    ]
    result = evaluate_segmenter(Scripted(found), *truth, quiet)
    assert result.iou_correlation > 0.99
    without_ring = evaluate_segmenter(Scripted(found[:3] + found[4:]), *truth, quiet)
    assert result.iou_correlation_of_good == pytest.approx(without_ring.iou_correlation)
    assert result.iou_correlation_of_good != pytest.approx(result.iou_correlation, abs=1e-4)


def test_the_command_gives_ap_one_for_the_truth(
    truth: tuple[CocoFile, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    _, folder = truth
    file = str(folder / "truth.json")
    command = ["evaluate-segmentation", "--data", file, "--images", str(folder), "--quiet"]
    picture = folder / "pr.png"
    extra = ["--segmenter", "precomputed", "--masks", file, "--plot", str(picture)]
    assert main([*command, *extra]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[-3:] for line in lines[1:4]] == [["1.0000"] * 3] * 3
    assert picture.is_file()
    assert isinstance(CocoSegmenter(Path(file)).labels.number("cup"), int)
