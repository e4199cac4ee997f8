"""The order of overlapping instances."""

from __future__ import annotations

import numpy as np

from bmask_slam.semantics.instances.instances import Instance, certain, mask_box, painting_order


def instance(mask: np.ndarray, label: int, score: float) -> Instance:
    return Instance(mask, mask_box(mask), label, certain(label, 4, score), score, score)


def case() -> dict[str, Instance]:
    """A bookcase whose mask has a hole at a book, a cup on its mask, a chair partly outside it.

    All have worse masks than the bookcase.
    """
    bookcase, book, cup, chair = (np.zeros((120, 160), bool) for _ in range(4))
    bookcase[20:100, 20:120] = True
    bookcase[40:64, 40:80] = False
    book[40:68, 40:80] = True
    cup[80:92, 60:80] = True
    chair[84:112, 100:150] = True
    shapes = {"bookcase": bookcase, "book": book, "cup": cup, "chair": chair}
    scores = (0.9, 0.5, 0.4, 0.3)
    rows = zip(shapes.items(), scores, strict=True)
    return {n: instance(m, k, s) for k, ((n, m), s) in enumerate(rows, 1) if k < 4} | {
        "chair": instance(chair, 2, 0.3)
    }


def test_small_masks_in_holes_of_larger_boxes_are_in_front() -> None:
    found = case()
    ranked, names = list(found.values()), list(found)
    by_masks = [names[k] for k in painting_order(ranked, 0.8, False)]
    by_boxes = [names[k] for k in painting_order(ranked, 0.8, True)]
    assert by_masks == ["chair", "book", "bookcase", "cup"]
    assert by_boxes == ["chair", "bookcase", "cup", "book"]


def test_masks_of_the_same_class_or_size_are_not_in_front() -> None:
    found = case()
    same = instance(found["cup"].mask, found["bookcase"].label, 0.4)
    large = np.zeros((120, 160), bool)
    large[24:96, 24:100] = True
    for other in (same, instance(large, 2, 0.4)):
        assert painting_order([found["bookcase"], other], 0.8, True).tolist() == [1, 0]
    assert painting_order([], 0.8, True).tolist() == []


def test_a_box_covers_whole_pixels() -> None:
    assert mask_box(case()["cup"].mask).tolist() == [60, 80, 80, 92]
    assert mask_box(np.zeros((5, 6), bool)).tolist() == [0, 0, 0, 0]
