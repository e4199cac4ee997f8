"""Stuff in the dense map: regions of keyframes, and their fusion beside instances."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from bmask_slam.mapping.products.surface_labels import InstanceEvidence, LabelTable, keyframe_labels
from bmask_slam.mapping.products.surface_regions import SURE, StuffFusion, find_regions
from bmask_slam.semantics.beliefs.label_store import LabelStoreConfig
from bmask_slam.semantics.beliefs.surface_geometry import Ground
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.instances.surfaces import Segmented, SurfaceClasses
from bmask_slam.semantics.labels import label_set

STUFF = label_set(("wall", "floor", "chair"))
THINGS = ("background", "chair", "cup")
FUSION = LabelStoreConfig()


def seen() -> SurfaceClasses:
    p = np.zeros((4, 4, 3), np.float16)
    p[:, :2], p[:, 2:] = [0.8, 0.1, 0.1], [0.2, 0.6, 0.2]
    return SurfaceClasses(STUFF, p, 8.0, (32, 32))


def test_regions_are_where_no_instance_is() -> None:
    free = np.ones((32, 32), bool)
    free[:8] = False
    found = find_regions(seen(), free)
    assert not found.numbers[:8].any()
    assert found.names == ("wall", "floor", "chair")
    wall, floor = (int(found.numbers[20, column]) for column in (2, 30))
    assert np.exp(found.log_p[wall - 1]) == pytest.approx([0.8, 0.1, 0.1], abs=0.02)
    assert np.exp(found.log_p[floor - 1]) == pytest.approx([0.2, 0.6, 0.2], abs=0.02)
    assert not find_regions(None, free).numbers.any()


def test_regions_are_those_of_plain_numpy() -> None:
    rng = np.random.default_rng(4)
    p = rng.dirichlet([0.3] * 3, (8, 8)).astype(np.float32)
    classes, free = SurfaceClasses(STUFF, p, 8.0, (64, 60)), rng.random((64, 60)) > 0.2
    found, pixels = find_regions(classes, free), classes.pixels()
    grades = (pixels.max(axis=2)[..., None] > SURE).sum(axis=2)
    keys = pixels.argmax(axis=2) * (len(SURE) + 1) + grades
    known = np.unique(keys[free])
    assert np.array_equal(found.numbers, np.where(free, np.searchsorted(known, keys) + 1, 0))
    means = np.array([pixels[free & (keys == key)].mean(axis=0) for key in known])
    np.testing.assert_allclose(np.exp(found.log_p), means, atol=1e-3)
    assert len(known) > 6


def test_names_that_both_have_are_one_class() -> None:
    joined = StuffFusion.of(THINGS, STUFF.names[1:])
    assert joined.names == ("background", "chair", "cup", "wall", "floor")
    assert joined.columns.tolist() == [3, 4, 1]


def test_a_thing_stands_before_stuff_and_stuff_before_nothing() -> None:
    mask = np.zeros((32, 32), bool)
    mask[:, :16] = True
    cup = Instance(mask, mask_box(mask), 2, certain(2, 3, 0.95), 0.95, 0.9)
    labels = keyframe_labels(Segmented([cup], seen()), (32, 32), 3, FUSION)
    assert int(labels.numbers[5, 5]) == 1
    floor = int(labels.numbers[5, 30])
    assert floor > 1  # behind the instances
    joined = StuffFusion.of(THINGS, STUFF.names[1:])
    none = np.zeros((1, 3), np.float32)  # a keyframe of a run without stuff
    table = LabelTable.of(
        [labels.log_likelihoods, none],
        FUSION,
        [labels.stuff.log_p, np.zeros((0, 0), np.float32)],
        joined,
    )
    assert len(table.submaps) == 2 + len(labels.stuff.log_p) + 1
    views = np.zeros((3, len(table.submaps)), np.float32)
    views[0, 1] = views[1, floor] = views[2, table.first[1]] = 1
    found, p = table.labels(csr_matrix(views), *np.zeros((2, 3, 3)))
    assert [joined.names[k] for k in found.tolist()] == ["cup", "floor", "background"]
    alone = 1 - (1 - FUSION.prior_unknown) * np.exp(FUSION.log_missed(np.ones(1)))[0] / (
        FUSION.prior_unknown + (1 - FUSION.prior_unknown) * np.exp(FUSION.log_missed(np.ones(1)))[0]
    )
    assert p[1] == pytest.approx(0.6 * alone, abs=0.02)


@pytest.mark.parametrize("others", [("wall", "floor"), ("floor", "wall", "chair")])
def test_regions_of_other_classes_tell_nothing(others: tuple[str, ...]) -> None:
    """A keyframe of another label set, before one of a cup: its points keep their numbers."""
    rows = np.log([[1, 1, 1], [0.01, 0.01, 2]]).astype(np.float32)
    log_p = np.log(np.full((2, len(others)), 1 / len(others), np.float32))
    nobody = np.zeros(0, np.int64)
    parts = [
        InstanceEvidence(rows[:1], nobody, nobody.astype(np.uint16), log_p, others),
        InstanceEvidence(rows, nobody, nobody.astype(np.uint16)),
    ]
    joined = StuffFusion.of(THINGS, STUFF.names[1:])
    stuff = [p.stuff_of(joined.stuff) for p in parts]
    for given in (stuff, [p.stuff for p in parts]) if len(others) == 2 else (stuff,):
        table = LabelTable.of([p.log_likelihoods for p in parts], FUSION, given, joined)
        assert table.first.tolist() == [0, 3]
        views = csr_matrix(np.eye(5, dtype=np.float32)[[0, 1, 2, 4]])
        found, p = table.labels(views, *np.zeros((2, 4, 3)))
        assert [joined.names[k] for k in found.tolist()] == ["background"] * 3 + ["cup"]
        assert p[1:3] == pytest.approx(p[0])  # a view without an instance


def test_what_lies_high_is_no_floor_and_what_stands_is_a_wall() -> None:
    ground = Ground(np.array([0.0, -1.0, 0.0]), -1.5)  # y down, the floor 1.5 m below the camera
    fusion = StuffFusion.of(THINGS, ("wall", "floor", "table"), ground)
    sums = np.log(np.array([[0.35, 0.35, 0.3]] * 3))
    points = np.array([[0, 1.5, 2.0], [0, 0.75, 2.0], [0, 0.0, 2.0]])
    normals = np.array([[0, -1.0, 0], [0, -1.0, 0], [0, 0.0, -1.0]])
    found, _ = fusion.labels(sums, np.ones(3), points, normals)
    assert [fusion.names[k] for k in found.tolist()] == ["floor", "table", "wall"]
