"""Labels of keyframes' instances, and the clouds of objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.object_clouds import (
    MARGIN_M,
    ObjectClouds,
    ObjectRegion,
    assign_regions,
)
from bmask_slam.mapping.products.surface_labels import (
    MIN_LANDMARKS,
    OTHER_SHARE,
    STRAY,
    InstanceEvidence,
    dilate,
)
from bmask_slam.semantics.objects.boxes3d import OrientedBox

PRIOR = np.array([0.5, 1 / 6, 1 / 6, 1 / 6])


def evidence(masks, instances) -> InstanceEvidence:
    return InstanceEvidence(
        np.log(masks / PRIOR).astype(np.float32), np.arange(len(instances)), np.array(instances)
    )


def test_landmarks_give_the_prior_of_an_instances_class() -> None:
    rng = np.random.default_rng(0)
    masks = rng.dirichlet(np.ones(4), 4)
    instances = np.array([1] * 20 + [2] * MIN_LANDMARKS + [3] * 9)
    given = evidence(masks, instances)
    p = rng.dirichlet(np.ones(4), len(instances))
    known = instances != 3
    found = given.with_landmarks(p, known, PRIOR)
    mean = p[:20, 1:].sum(axis=0) / p[:20, 1:].sum()
    which = np.sqrt(masks[1, 1:] / PRIOR[1:]) * ((1 - STRAY) * mean + STRAY / 3)
    believed = np.r_[masks[1, 0], (1 - masks[1, 0]) * which / which.sum()]
    expected = np.log((1 - OTHER_SHARE) * believed / PRIOR + OTHER_SHARE)
    np.testing.assert_allclose(found[1], expected, atol=1e-5)
    others = [0, 2, 3]  # of 2 the landmarks are in part on nothing
    np.testing.assert_array_equal(found[others], given.log_likelihoods[others])


def test_landmarks_of_an_object_on_an_instance_do_not_overrule_its_mask() -> None:
    """A table whose mask covers a box with more landmarks than its own top."""
    table = np.array([0.4, 0.588, 0.006, 0.006])
    p = np.zeros((30, 4))
    p[:16, 2] = 1
    p[16:, 1] = 1
    given = evidence(table[None], [0] * 30)
    all_known = np.ones(30, bool)
    assert given.with_landmarks(p, all_known, PRIOR)[0].argmax() == 1
    p[:, 2], p[:, 1] = 1, 0  # all of them say that it is the other
    assert given.with_landmarks(p, all_known, PRIOR)[0].argmax() == 2


def test_dilation_grows_masks_by_the_margin() -> None:
    shown = np.zeros((20, 30), bool)
    shown[10, 12] = True
    rows, columns = np.nonzero(dilate(shown, 3))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (7, 13, 9, 15)


def cloud(points, labels) -> Cloud:
    n = len(points)
    return Cloud(
        np.asarray(points, np.float32), np.zeros((n, 3), np.float32), np.zeros((n, 3), np.uint8),
        np.ones(n, np.float32), np.asarray(labels, np.uint16), np.ones(n, np.float32),
        np.ones(n, np.uint16),
    )  # fmt: skip


def test_points_belong_to_the_object_whose_box_contains_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    poses = [se3_exp(np.r_[rng.normal(0, 0.5, 3), shift, 0, 0]) for shift in (0.0, 0.3, 3.0)]
    size = np.array([0.5, 0.4, 0.6])
    regions = [ObjectRegion(f"o{k}", 1 + k // 2, OrientedBox(T, size)) for k, T in enumerate(poses)]
    points = rng.uniform(-1, 4, (3000, 3)) * [1, 0.3, 0.3]
    labels = rng.integers(0, 3, 3000)
    given = cloud(points, labels)
    found = assign_regions(given, regions)
    for p, label, mine in zip(given.points.astype(float), labels, found, strict=True):
        fits = []
        for k, (T, region) in enumerate(zip(poses, regions, strict=True)):
            local = np.linalg.inv(T) @ np.r_[p, 1]
            if region.label == label and (np.abs(local[:3]) <= size / 2 + MARGIN_M).all():
                fits.append((np.linalg.norm(local[:3]), k))
        assert mine == (min(fits)[1] if fits else -1)
    with ObjectClouds(tmp_path / "objects", regions) as clouds:
        for rows in (slice(0, 1000), slice(1000, 3000)):
            clouds.write(cloud(points[rows], labels[rows]))
    assert [f.stem for f in clouds.files] == ["o0", "o1", "o2"]
    for k, file in enumerate(clouds.files):
        assert len(read_ply(file)["x"]) == np.count_nonzero(found == k) > 0
