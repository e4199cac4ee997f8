"""The landmarks for which a keyframe's masks vote, and their votes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.beliefs.pixel_assignment import assign_pixels, grouped_median
from bmask_slam.semantics.beliefs.vote_config import VoteConfig
from bmask_slam.semantics.beliefs.votes import vote
from bmask_slam.semantics.instances.instances import (
    Instance,
    certain,
    check_instances,
    mask_box,
)
from bmask_slam.semantics.labels import label_set

SIZE = (120, 160)
LABELS = label_set(("chair", "desk", "cup"))
CONFIG = VoteConfig(border_px=3, background_border_px=5, border_weight=0.0)


def instance(rows: slice, columns: slice, label: int, score: float = 0.9) -> Instance:
    mask = np.zeros(SIZE, bool)
    mask[rows, columns] = True
    return Instance(mask, mask_box(mask), label, certain(label, 4, score), score, score)


def flat(z_m: float = 2.0, step: int = 2) -> np.ndarray:
    return np.full((SIZE[0] // step, SIZE[1] // step), z_m, np.float32)


CHAIR = instance(slice(20, 80), slice(30, 90), 1)


def test_a_landmark_on_an_instance_gets_its_distribution_and_score() -> None:
    assignment = assign_pixels([CHAIR], flat(), SIZE, CONFIG)
    pixels = np.array([[60.2, 50.4], [140.0, 50.0]])  # column, row
    found = vote(assignment, pixels, np.array([2.0, 3.0]), 4, CONFIG)
    assert found.rows.tolist() == [0, 1]
    assert found.instances.tolist() == [0, -1]
    assert found.missed.tolist() == [False, True]
    assert np.allclose(found.distributions, [CHAIR.distribution, [0, 0, 0, 0]])
    assert found.weights == pytest.approx([0.9, 1.0])


def test_columns_and_rows_are_not_exchanged() -> None:
    assignment = assign_pixels([CHAIR], flat(), SIZE, CONFIG)
    found = vote(assignment, np.array([[50.0, 100.0]]), np.array([2.0]), 4, CONFIG)
    assert found.instances.tolist() == [-1]  # column 50, row 100 is below; row 50 would be inside


def test_near_a_mask_border_no_landmark_votes() -> None:
    assignment = assign_pixels([CHAIR], flat(), SIZE, CONFIG)
    columns = np.arange(20, 100)
    pixels = np.stack([columns, np.full(len(columns), 50)], axis=1).astype(float)
    found = vote(assignment, pixels, np.full(len(columns), 2.0), 4, CONFIG)
    silent = np.setdiff1d(columns, columns[found.rows])
    assert silent.tolist() == [*range(25, 33), *range(87, 95)]
    half = replace(CONFIG, border_weight=0.5)
    found = vote(assignment, pixels, np.full(len(columns), 2.0), 4, half)
    assert len(found.rows) == len(columns)
    assert np.array_equal(columns[~found.sure], silent)
    assert (found.instances[~found.sure] == -1).all()
    on_mask = (columns >= 30) & (columns < 90)
    assert np.array_equal(found.missed, ~on_mask)
    weights = np.where(on_mask, 0.9, 1.0) * np.where(found.sure, 1.0, 0.5)
    assert found.weights == pytest.approx(weights)


def test_the_image_edge_is_not_a_mask_border() -> None:
    corner = instance(slice(0, 60), slice(0, 60), 2)
    assignment = assign_pixels([corner], flat(), SIZE, CONFIG)
    found = vote(assignment, np.array([[0.0, 0.0]]), np.array([2.0]), 4, CONFIG)
    assert found.instances.tolist() == [0]


def test_a_pixel_belongs_to_the_better_of_overlapping_masks() -> None:
    cup = instance(slice(40, 70), slice(50, 80), 3, 0.95)
    for given in ([CHAIR, cup], [cup, CHAIR]):
        assignment = assign_pixels(given, flat(), SIZE, CONFIG)
        found = vote(assignment, np.array([[65.0, 55.0], [40.0, 30.0]]), np.full(2, 2.0), 4, CONFIG)
        labels = [assignment.instances[k].label for k in found.instances]
        assert labels == [3, 1]
    worse = instance(slice(40, 110), slice(50, 140), 3, 0.5)
    assignment = assign_pixels([worse, CHAIR], flat(), SIZE, CONFIG)
    found = vote(assignment, np.array([[65.0, 55.0]]), np.array([2.0]), 4, CONFIG)
    assert assignment.instances[found.instances[0]].label == 1


def test_a_mask_inside_a_larger_one_of_another_class_is_in_front() -> None:
    inside, part = (instance(slice(40, 60), slice(40, 60), label, 0.3) for label in (3, 1))
    large = instance(slice(40, 80), slice(34, 90), 3, 0.3)
    for other, label in ((inside, 3), (part, 1), (large, 1)):
        assignment = assign_pixels([CHAIR, other], flat(), SIZE, CONFIG)
        found = vote(assignment, np.array([[50.0, 50.0]]), np.array([2.0]), 4, CONFIG)
        front = assignment.instances[found.instances[0]]
        assert front.label == label
        assert (front.mask_score == 0.3) == (other is inside)


def test_outside_the_front_mask_the_one_behind_votes() -> None:
    cup = instance(slice(40, 60), slice(40, 60), 3, 0.3)
    assignment = assign_pixels([CHAIR, cup], flat(), SIZE, CONFIG)
    found = vote(assignment, np.array([[50.0, 50.0], [80.0, 70.0]]), np.full(2, 2.0), 4, CONFIG)
    assert found.weights == pytest.approx([0.3 + 0.7 * 0.9, 0.9])
    expected = (0.3 * cup.distribution + 0.7 * 0.9 * CHAIR.distribution) / (0.3 + 0.7 * 0.9)
    assert np.allclose(found.distributions, [expected, CHAIR.distribution])


def test_a_landmark_that_is_not_on_the_surface_does_not_vote() -> None:
    """The mask covers some of a wall at 4 m; a person is in front of it at 1 m."""
    depth_m = flat(2.0) + np.random.default_rng(0).normal(0, 0.02, flat().shape)
    depth_m[10:40, 40:45] = 4.0
    assignment = assign_pixels([CHAIR], depth_m.astype(np.float32), SIZE, CONFIG)
    pixels = np.tile([[60.0, 50.0]], (4, 1))
    found = vote(assignment, pixels, np.array([1.0, 2.02, 4.0, np.nan]), 4, CONFIG)
    assert found.rows.tolist() == [1, 3]  # of an unknown depth nothing speaks against it


def test_a_slanted_surface_votes_completely() -> None:
    depth_m = np.repeat(np.linspace(3.5, 0.9, SIZE[0] // 2)[:, None], SIZE[1] // 2, axis=1)
    assignment = assign_pixels([CHAIR], depth_m.astype(np.float32), SIZE, CONFIG)
    rows = np.arange(24, 76)
    pixels = np.stack([np.full(len(rows), 60), rows], axis=1).astype(float)
    z_m = np.interp(rows, np.arange(0, SIZE[0], 2), depth_m[:, 0])
    assert len(vote(assignment, pixels, z_m, 4, CONFIG).rows) == len(rows)


def stepped() -> np.ndarray:
    """The chair at 2 m before a wall at 4 m, at every second pixel."""
    depth_m = flat(4.0)
    depth_m[10:40, 15:45] = 2.0
    return depth_m


def test_near_a_border_depth_decides_the_side() -> None:
    assignment = assign_pixels([CHAIR], stepped(), SIZE, CONFIG)
    columns = np.array([28, 31, 33, 31, 28, 31])  # the mask begins at column 30
    z_m = np.array([2.0, 2.02, 1.99, 4.0, 4.0, np.nan])
    pixels = np.stack([columns, np.full(6, 50)], axis=1).astype(float)
    found = vote(assignment, pixels, z_m, 4, CONFIG)
    assert found.rows.tolist() == [0, 1, 2]  # the wall's landmarks stay silent: it may be missed
    assert found.instances.tolist() == [0, 0, 0]
    assert np.allclose(found.distributions, CHAIR.distribution)
    without = replace(CONFIG, edge_px=0)
    assert vote(assignment, pixels[[0, 1]], z_m[[0, 1]], 4, without).rows.tolist() == []


def test_near_a_border_depth_is_that_of_the_place_in_odd_images_too() -> None:
    size = SIZE[0] + 1, SIZE[1] + 1
    chair = replace(CHAIR, mask=np.pad(CHAIR.mask, ((0, 1), (0, 1))))
    depth_m = np.full(size, 4.0, np.float32)
    depth_m[chair.mask] = 2.0
    assignment = assign_pixels([chair], depth_m[::2, ::2], size, CONFIG)
    pixels, z_m = np.array([[31.0, 50.0], [31.0, 50.0]]), np.array([2.02, 4.0])
    found = vote(assignment, pixels, z_m, 4, CONFIG)
    assert found.rows.tolist() == [0] and found.instances.tolist() == [0]


def test_at_a_border_of_two_instances_of_a_class_only_the_class_is_known() -> None:
    for label, rows in ((1, [0]), (2, [])):
        right = instance(slice(20, 80), slice(90, 140), label, 0.7)
        depth_m = flat(4.0)
        depth_m[10:40, 15:70] = 2.0
        assignment = assign_pixels([CHAIR, right], depth_m, SIZE, CONFIG)
        found = vote(assignment, np.array([[90.0, 50.0]]), np.array([2.0]), 4, CONFIG)
        assert found.rows.tolist() == rows
        assert found.instances.tolist() == [-1] * len(rows)
        assert np.allclose(found.weights, 0.7)


def test_without_depth_and_without_instances() -> None:
    assignment = assign_pixels([CHAIR], np.full_like(flat(), np.nan), SIZE, CONFIG)
    pixels, z_m = np.array([[60.0, 50.0]]), np.array([2.0])
    assert vote(assignment, pixels, z_m, 4, CONFIG).instances.tolist() == [0]
    nothing = assign_pixels([], flat(), SIZE, CONFIG)
    assert vote(nothing, pixels, z_m, 4, CONFIG).instances.tolist() == [-1]
    assert vote(nothing, pixels, z_m, 4, CONFIG).missed.tolist() == [True]
    assert len(vote(nothing, np.zeros((0, 2)), np.zeros(0), 4, CONFIG).rows) == 0


@pytest.mark.parametrize("logits", [[0.0, 3.1, -2.0, 0.4], [0.0, 0.5, -0.5, 1.0]])
def test_logits_are_no_probabilities(logits: list[float]) -> None:
    bad = Instance(CHAIR.mask, CHAIR.box, 1, np.array(logits, np.float32), 0.9, 0.9)
    with pytest.raises(InputError, match="a class probability is not between 0 and 1"):
        check_instances([bad], SIZE, LABELS, "keyframe 7")


def test_masks_of_another_image_or_label_set_are_refused() -> None:
    small = np.ones((60, 80), bool)
    strange = certain(1, 4)
    for bad in (
        Instance(small, mask_box(small), 1, strange, 1.0, 1.0),
        Instance(CHAIR.mask, CHAIR.box, 4, strange, 1.0, 1.0),
        Instance(CHAIR.mask, CHAIR.box, 0, strange, 1.0, 1.0),
        Instance(CHAIR.mask, CHAIR.box, 1, certain(1, 9), 1.0, 1.0),
        Instance(CHAIR.mask, CHAIR.box, 1, strange, 1.0, float("nan")),
        Instance(CHAIR.mask, CHAIR.box, 1, np.full(4, np.nan, np.float32), 1.0, 1.0),
    ):
        with pytest.raises(InputError, match=r"^keyframe 7: .*(give|make) "):
            check_instances([CHAIR, bad], SIZE, LABELS, "keyframe 7")
    check_instances([CHAIR], SIZE, LABELS, "keyframe 7")


def test_grouped_median_equals_a_loop_over_groups() -> None:
    rng = np.random.default_rng(3)
    values, groups = rng.normal(size=301), rng.integers(0, 6, 301)
    groups[groups == 2] = 3
    found = grouped_median(values, groups, 7)
    for k in range(7):
        own = np.sort(values[groups == k])
        expected = own[len(own) // 2] if len(own) else np.nan
        assert np.array_equal(found[k], expected, equal_nan=True)
