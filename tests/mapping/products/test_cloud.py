"""Clouds: their files, and their labels against a loop over points."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csr_matrix

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.pictures import palette, write_picture
from bmask_slam.mapping.products.surface_labels import LabelTable, keyframe_labels
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box

RNG = np.random.default_rng(0)


def cloud(count: int = 400) -> Cloud:
    """Points at random."""
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(
        RNG.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        normals.astype(np.float32),
        RNG.integers(0, 255, (count, 3)).astype(np.uint8),
        RNG.uniform(1e-3, 1e-1, count).astype(np.float32),
        RNG.integers(0, 5, count).astype(np.uint16),
        RNG.uniform(0, 1, count).astype(np.float32),
        np.ones(count, np.uint16),
    )


def table(rows: list[int], classes: int) -> LabelTable:
    """A table for keyframes with these numbers of rows; the first row is of no instance."""
    evidence = [RNG.normal(0, 2, (n, classes)).astype(np.float32) for n in rows]
    for keyframe in evidence:
        keyframe[0] = 0
    return LabelTable.of(evidence, LabelStoreConfig())


def labels_of(views: Array, table: LabelTable) -> tuple[Array, Array]:
    """Labels and probabilities of points with views (N, I)."""
    return table.labels(csr_matrix(views.astype(np.float32)), *np.zeros((2, len(views), 3)))


def test_labels_equal_a_loop_over_points_and_keyframes() -> None:
    given, points = table([3, 2, 4], 5), 60
    views = np.zeros((points, 9))
    for k, size in enumerate((3, 2, 4)):
        on = RNG.integers(0, size, points) + given.first[k]
        seen = RNG.random(points) < 0.7
        views[np.flatnonzero(seen), on[seen]] = 1
    labels, probabilities = labels_of(views, given)
    store, rows = LabelStoreConfig(), given.log_likelihoods.astype(float)
    for p in range(points):
        evidence = np.log(store.prior(5)) + views[p] @ rows
        evidence[1:] += store.log_missed(np.array(views[p, given.first].sum()))
        share = np.exp(evidence) / np.exp(evidence).sum()
        assert labels[p] == share.argmax()
        assert abs(probabilities[p] - share.max()) < 1e-4


def test_objects_in_several_views_are_kept_and_in_one_view_dropped() -> None:
    """As in the label store: misses of an object are not independent."""
    store, classes = LabelStoreConfig(), 40
    distribution = np.zeros(classes, np.float32)
    distribution[2] = 0.6
    distribution[0] = 0.4
    word = np.log(store.likelihoods(distribution[None], np.float32([0.8])))
    for found, missed, label in ((3, 8, 2), (1, 100, 0), (0, 5, 0)):
        keyframes = [np.r_[np.zeros((1, classes), np.float32), word]] * (found + missed)
        evidence = LabelTable.of(keyframes, store)
        views = np.zeros((1, len(evidence.submaps)))
        views[0, evidence.first + (np.arange(found + missed) < found)] = 1
        assert labels_of(views, evidence)[0] == [label]
        labels = LabelStore(classes, store)
        for k in range(found + missed):
            if k < found:
                labels.update(np.zeros(1, np.int64), distribution[None], np.float32([0.8]))
            else:
                labels.miss(np.zeros(1, np.int64), np.ones(1, np.float32))
        assert labels.estimates(np.zeros(1, np.int64)).labels == [label]


def test_files_are_read_back(tmp_path: Path) -> None:
    first, second = cloud(), cloud(30)
    with CloudWriter(tmp_path / "cloud", pcd=True) as writer:
        writer.write(first)
        writer.write(second)
    columns = read_ply(tmp_path / "cloud.ply")
    assert len(columns["x"]) == writer.count == 430
    np.testing.assert_array_equal(columns["x"][: len(first)], first.points[:, 0])
    np.testing.assert_array_equal(columns["red"][: len(first)], first.colours[:, 0])
    io = load_open3d().io
    for name in ("cloud.ply", "cloud.pcd"):
        read = io.read_point_cloud(str(tmp_path / name))
        np.testing.assert_allclose(np.asarray(read.points)[: len(first)], first.points, atol=1e-6)
        np.testing.assert_allclose(
            255 * np.asarray(read.colors)[: len(first)], first.colours, atol=0.5
        )
        np.testing.assert_allclose(np.asarray(read.normals)[: len(first)], first.normals, atol=1e-6)


def test_without_pcd_an_old_one_does_not_stay(tmp_path: Path) -> None:
    for pcd in (True, False):
        with CloudWriter(tmp_path / "cloud", pcd=pcd) as writer:
            writer.write(cloud())
        assert (tmp_path / "cloud.pcd").exists() is pcd
        assert (tmp_path / "cloud.ply").exists()


def test_a_failure_leaves_no_file(tmp_path: Path) -> None:
    try:
        with CloudWriter(tmp_path / "cloud", palette(("background", "table", "cup"))):
            raise KeyError
    except KeyError:
        assert list(tmp_path.iterdir()) == []


def instance(rows: slice, label: int, score: float, mask_score: float) -> Instance:
    mask = np.zeros((6, 8), bool)
    mask[rows] = True
    return Instance(mask, mask_box(mask), label, certain(label, 4, score), score, mask_score)


def test_the_better_of_overlapping_masks_is_used() -> None:
    found = [instance(slice(0, 3), 1, 0.9, 0.4), instance(slice(2, 5), 2, 0.9, 0.8)]
    labels = keyframe_labels(found, (6, 8), 4, LabelStoreConfig())
    np.testing.assert_array_equal(labels.numbers[:, 0], [1, 1, 2, 2, 2, 0])


def test_a_better_mask_has_more_weight() -> None:
    found = [instance(slice(0, 3), 1, 0.9, 0.9), instance(slice(3, 5), 1, 0.9, 0.3)]
    evidence = keyframe_labels(found, (6, 8), 4, LabelStoreConfig()).log_likelihoods
    np.testing.assert_allclose(np.exp(evidence) @ LabelStoreConfig().prior(4), 1, rtol=1e-5)
    assert evidence[1, 1] > evidence[2, 1] > 0 > evidence[2, 2] > evidence[1, 2]
    assert not evidence[0].any()
    assert np.isfinite(evidence).all()


def test_a_picture_whose_last_bytes_find_no_space_is_not_written(tmp_path: Path) -> None:
    image = RNG.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    size = write_picture(tmp_path / "whole.png", image).stat().st_size
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size - 50, before[1]))
    try:
        with pytest.raises(InputError, match=r"cut\.png: cannot be written"):
            write_picture(tmp_path / "cut.png", image)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert [path.name for path in tmp_path.iterdir()] == ["whole.png"]
    with pytest.raises(InputError, match="No such file or directory"):
        write_picture(tmp_path / "nowhere" / "a.png", image)
