"""COCO files: which objects are read and which are skipped."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pycocotools import mask as coco_mask
from repository import shared

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.instances import coco_files
from bmask_slam.semantics.instances.coco_files import read_coco
from bmask_slam.semantics.instances.run_lengths import decoded_lengths, run_lengths

SQUARE = [2.0, 3.0, 6.0, 3.0, 6.0, 9.0, 2.0, 9.0]


def write(path: Path, annotations: list[Any]) -> Path:
    content = {
        "images": [{"id": 7, "file_name": "a.png", "height": 12, "width": 10}],
        "categories": [{"id": 40, "name": "cup"}, {"id": 5, "name": "mouse"}],
        "annotations": annotations,
    }
    path.write_text(json.dumps(content))
    return path


def annotation(**changes: Any) -> dict[str, Any]:
    return {"id": 1, "image_id": 7, "category_id": 40, "segmentation": [SQUARE], **changes}


def test_polygons_and_both_kinds_of_run_lengths(tmp_path: Path) -> None:
    plain = {"size": [12, 10], "counts": [0, 12, 12, 24, 72]}  # columns 0, 2 and 3
    objects = [annotation(), annotation(segmentation=plain, category_id=5, iscrowd=1)]
    content = read_coco(write(tmp_path / "c.json", objects))
    assert content.labels.names == ("background", "mouse", "cup")
    assert content.category_ids == (0, 5, 40)
    (image,) = content.images
    polygon, runs = image.objects
    assert (polygon.label, runs.label) == (2, 1)
    expected = np.zeros((12, 10), bool)
    expected[3:9, 2:6] = True
    assert np.array_equal(polygon.mask(), expected)
    assert polygon.box == (2, 3, 6, 9)
    columns = np.zeros((12, 10), bool)
    columns[:, [0, 2, 3]] = True
    assert np.array_equal(runs.mask(), columns)
    assert runs.crowd and not polygon.crowd


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"segmentation": []}, "no valid polygon"),
        ({"segmentation": [[1, 2, 3, 4]]}, "no valid polygon"),
        ({"segmentation": [[1, 2, 3, 4, float("nan"), 5]]}, "no valid polygon"),
        ({"segmentation": [[50, 50, 60, 50, 60, 60]]}, "mask is empty"),
        ({"segmentation": None}, "no segmentation"),
        ({"segmentation": {"size": [9, 9], "counts": [81]}}, "size"),
        ({"segmentation": {"size": [12, 10], "counts": [5, 6]}}, "do not add up to 120"),
        ({"segmentation": {"size": [12, 10], "counts": "1" * 1000 + "o"}}, "no compressed numbers"),
        ({"segmentation": {"size": [12, 10], "counts": "1" * 1000}}, "do not add up to 120"),
        ({"segmentation": {"size": [12, 10], "counts": "o"}}, "no compressed numbers"),
        ({"segmentation": {"size": [12, 10], "counts": "\u20ac"}}, "no compressed numbers"),
        ({"segmentation": {"size": [12, 10], "counts": [2**62, 2**62]}}, "counts"),
        ({"segmentation": [[0, 0, 1e9, 0, 1e9, 1e9]]}, "no valid polygon"),
        ({"segmentation": [[0.0, 0.0, 1e6, 1e6] * 6000]}, "no valid polygon"),
        ({"segmentation": [["0", 0, 5, 0, 5, 5]]}, "no valid polygon"),
        ({"image_id": [7]}, "image_id: input should be a valid integer"),
        ({"score": float("inf")}, "score"),
        ({"distribution": ["a"]}, "distribution.0"),
        ({"image_id": 99}, "image_id 99"),
        ({"category_id": 1}, "category_id 1"),
    ],
)
def test_a_broken_object_is_reported_and_the_others_are_used(
    tmp_path: Path, change: dict[str, Any], words: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = write(tmp_path / "c.json", [annotation(id=3, **change), annotation()])
    content = read_coco(path)
    assert len(content.images[0].objects) == 1
    assert len(content.problems) >= 1
    assert "annotation 3" in content.problems[-1]
    assert words in content.problems[-1]
    assert "c.json" in caplog.text


def test_many_long_polygons_take_no_minutes(tmp_path: Path) -> None:
    """Each of 100 bytes took half a second and 100 MB; real ones are never so long."""
    around = [[-2e6, -2e6, 1e6, -2e6, 1e6, 1e6]]
    path = write(tmp_path / "c.json", [annotation(segmentation=around)] * 40 + [annotation()])
    content = read_coco(path)
    assert [problem.partition(": ")[2] for problem in content.problems] == [
        "segmentation: the edges of the file's polygons are too long; left out"
    ] * len(content.problems)
    assert len(content.problems) >= 38
    assert content.images[0].objects[-1].mask().sum() == 24


def test_masks_of_an_image_take_no_gigabytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(coco_files, "MAX_MASK_BYTES", 3 * 12 * 10)
    content = read_coco(write(tmp_path / "c.json", [annotation()] * 5))
    assert len(content.images[0].objects) == 3
    assert len(content.problems) == 2
    assert "image 7 has 3 objects, which is the limit of its size" in content.problems[0]


def test_the_good_polygons_of_an_object_are_used(tmp_path: Path) -> None:
    path = write(tmp_path / "c.json", [annotation(segmentation=[SQUARE, [1, 2]])])
    content = read_coco(path)
    assert content.images[0].objects[0].mask().sum() == 24
    assert "1 invalid polygons" in content.problems[0]


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"images":[],"annotations":[],"categories":[]}']
)
def test_other_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"bad\.json"):
        read_coco(path)
    with pytest.raises(InputError, match=r"none\.json: no such file"):
        read_coco(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"height": 0}, "images.0.height"),
        ({"height": 60_000, "width": 60_000}, "megapixels"),
        ({"width": 70_000}, "images.0.width"),
        ({"id": [1]}, "images.0.id"),
        ({"file_name": "../../victim/x.png"}, "image 7: '../../victim/x.png' leads out"),
        ({"file_name": 5}, "images.0.file_name"),
    ],
)
def test_impossible_images_are_refused(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "c.json", [annotation()])
    content = json.loads(path.read_text())
    content["images"][0].update(change)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"c\.json: ") as caught:
        read_coco(path)
    assert words in str(caught.value)


@pytest.mark.parametrize("listed", ["images", "categories"])
def test_ids_that_stand_twice_are_refused(tmp_path: Path, listed: str) -> None:
    """As in a file that was joined from two."""
    path = write(tmp_path / "c.json", [annotation()])
    content = json.loads(path.read_text())
    first = content[listed][0]
    content[listed].append({**first, **({"file_name": "b.png"} if "file_name" in first else {})})
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=rf"id {first['id']} stands 2 times"):
        read_coco(path)


def test_an_image_that_is_named_in_two_ways_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "c.json", [annotation()])
    content = json.loads(path.read_text())
    content["images"].append({**content["images"][0], "id": 8, "file_name": "./a.png"})
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"image a\.png stands 2 times"):
        read_coco(path)


def test_a_score_that_rounding_put_above_one_is_one(tmp_path: Path) -> None:
    path = write(tmp_path / "c.json", [annotation(score=1.0000001)])
    assert read_coco(path).images[0].objects[0].score == 1.0


def test_run_lengths_start_with_zeros() -> None:
    mask = np.array([[True, False], [True, True]])
    assert run_lengths(mask) == [0, 2, 1, 1]
    assert run_lengths(~mask) == [2, 1, 1]


@settings(deadline=None)
@given(st.lists(st.integers(0, 70_000), max_size=40))
def test_compressed_run_lengths_are_decoded(lengths: list[int]) -> None:
    height, width = 1, max(sum(lengths), 1)
    plain = {"size": [height, width], "counts": lengths or [1]}
    text = coco_mask.frPyObjects(plain, height, width)["counts"].decode()
    assert decoded_lengths(text).tolist() == (lengths or [1])


def compressed(values: list[int]) -> str:
    """COCO's text of numbers, each of which it holds as it is or as a difference."""
    text = ""
    for value in values:
        left, ends = value, False
        while not ends:
            low, left = left & 31, left >> 5
            ends = left == (-1 if low & 16 else 0)
            text += chr(48 + low + (0 if ends else 32))
    return text


def test_run_lengths_whose_sum_overflows_are_refused(tmp_path: Path) -> None:
    """Their sum modulo 2^64 is the image's size; each is far larger than the image."""
    largest, pixels = (1 << 34) - 1, 120
    count = next(n for n in range(1 << 16) if largest * (n + 1) * (n + 2) // 2 > (1 << 64) + pixels)
    rising = [largest * k for k in range(1, count + 1)]
    share, rest = divmod((1 << 64) + pixels - sum(rising), count)
    lengths = [0] + [x for y in rising for x in (y, share)]
    lengths[-1] += rest
    differences = lengths[:3] + [b - a for a, b in zip(lengths[1:], lengths[3:], strict=False)]
    text = compressed(differences)
    assert sum(decoded_lengths(text).tolist()) == (1 << 64) + pixels
    runs = {"size": [12, 10], "counts": text}
    (problem,) = read_coco(write(tmp_path / "c.json", [annotation(segmentation=runs)])).problems
    assert "run lengths that do not add up to 120 pixels" in problem


def test_the_real_excerpt() -> None:
    content = read_coco(shared("coco_excerpt/instances.json"))
    assert len(content.images) == 355
    assert len(content.labels) == 81
    found = sum(len(image.objects) for image in content.images)
    assert found + len(content.problems) >= 2919
    assert found > 2900
