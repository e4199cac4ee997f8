"""Labels of keyframes' instances, and the clouds of objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from graph.geometry import se3_exp
from graph.ply import read_ply
from mapping.cloud import Cloud
from mapping.labels import MIN_LANDMARKS, OTHER_SHARE, InstanceEvidence, widened
from mapping.object_clouds import MARGIN_M, ObjectClouds, ObjectRegion, owners
from semantics.boxes3d import OrientedBox


def test_landmarks_speak_for_the_instances_that_have_enough_of_them() -> None:
    rng = np.random.default_rng(0)
    masks = rng.normal(size=(4, 3)).astype(np.float32)
    instances = np.array([1] * (MIN_LANDMARKS + 1) + [2] * (MIN_LANDMARKS - 1) + [3] * 9)
    evidence = InstanceEvidence(masks, np.arange(len(instances)), instances.astype(np.uint16))
    p = rng.dirichlet(np.ones(3), len(instances))
    known = instances != 3
    found = evidence.with_landmarks(p, known)
    mean = np.mean([row for row, k in zip(p, instances, strict=True) if k == 1], axis=0)
    np.testing.assert_allclose(
        np.exp(found[1]), (1 - OTHER_SHARE) * mean + OTHER_SHARE / 3, rtol=1e-5
    )
    np.testing.assert_array_equal(found[[0, 2, 3]], masks[[0, 2, 3]])


def test_widened_reaches_as_far_as_it_says() -> None:
    shown = np.zeros((20, 30), bool)
    shown[10, 12] = True
    rows, columns = np.nonzero(widened(shown, 3))
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (7, 13, 9, 15)


def cloud(points, labels) -> Cloud:
    n = len(points)
    return Cloud(
        np.asarray(points, np.float32), np.zeros((n, 3), np.float32), np.zeros((n, 3), np.uint8),
        np.ones(n, np.float32), np.asarray(labels, np.uint16), np.ones(n, np.float32),
        np.ones(n, np.uint16),
    )  # fmt: skip


def test_points_go_to_the_object_whose_box_holds_them(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    poses = [se3_exp(np.r_[rng.normal(0, 0.5, 3), shift, 0, 0]) for shift in (0.0, 0.3, 3.0)]
    size = np.array([0.5, 0.4, 0.6])
    regions = [ObjectRegion(f"o{k}", 1 + k // 2, OrientedBox(T, size)) for k, T in enumerate(poses)]
    points = rng.uniform(-1, 4, (3000, 3)) * [1, 0.3, 0.3]
    labels = rng.integers(0, 3, 3000)
    given = cloud(points, labels)
    found = owners(given, regions)
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
