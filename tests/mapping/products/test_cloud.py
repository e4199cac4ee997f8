"""The merged cloud against a loop over voxels; its files; its labels."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np

from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.geometry import make_pose, se3_exp
from bmask_slam.mapping.open3d_loader import load_open3d
from bmask_slam.mapping.products.cloud import (
    BLOCK_VOXELS,
    PlacedSubmap,
    _fused_labels,
    merge_blocks,
    sort_into_blocks,
)
from bmask_slam.mapping.products.cloud_files import CloudWriter
from bmask_slam.mapping.products.pictures import palette
from bmask_slam.mapping.products.submaps import Submap
from bmask_slam.mapping.products.surface_labels import LabelTable, keyframe_labels
from bmask_slam.semantics.beliefs.label_fusion import LabelStoreConfig
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box

RNG = np.random.default_rng(0)
VOXEL_M = 0.1


def submap(anchor: int, count: int = 400, instances: int = 3) -> Submap:
    normals = RNG.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Submap(
        anchor,
        RNG.uniform(-0.5, 0.5, (count, 3)).astype(np.float32),
        normals.astype(np.float32),
        RNG.integers(0, 255, (count, 3)).astype(np.uint8),
        RNG.uniform(1e-4, 1e-2, count).astype(np.float32),
        RNG.integers(0, instances, count).astype(np.uint16),
    )


def table(rows: list[int], classes: int) -> LabelTable:
    """A table for submaps with these numbers of rows; the first row is of no instance."""
    evidence = [RNG.normal(0, 2, (n, classes)).astype(np.float32) for n in rows]
    for keyframe in evidence:
        keyframe[0] = 0
    return LabelTable.of(evidence, LabelStoreConfig())


def test_the_cloud_equals_a_loop_over_voxels(tmp_path: Path) -> None:
    placed = [
        PlacedSubmap(submap(0), se3_exp(RNG.normal(0, 0.3, 6)), 0),
        PlacedSubmap(submap(1), np.eye(4), 3),
    ]
    clouds = list(
        merge_blocks(sort_into_blocks(placed, VOXEL_M, tmp_path), VOXEL_M, table([3, 3], 4))
    )
    points = np.concatenate([c.points for c in clouds])
    expected = defaultdict(list)
    for given in placed:
        part = given.submap
        at, _ = part.placed(given.T_world_anchor)
        for k in range(len(part)):
            voxel = tuple(np.floor(at[k] / VOXEL_M).astype(int))
            expected[voxel].append((at[k], 1 / part.variances[k]))
    assert len(points) == len(expected)
    for cloud in clouds:
        for k in range(len(cloud)):
            rows = expected[tuple(np.floor(cloud.points[k] / VOXEL_M).astype(int))]
            weights = np.array([w for _, w in rows])
            mean = sum(p * w for p, w in rows) / weights.sum()
            np.testing.assert_allclose(cloud.points[k], mean, atol=1e-5)
            assert cloud.views[k] == len(rows)
            assert abs(cloud.sigmas_m[k] - weights.max() ** -0.5) < 1e-5


def test_labels_equal_a_loop_over_voxels_and_submaps() -> None:
    """Each submap counts once; one without a point in the voxel, by its points in the cell."""
    log_likelihoods, points, voxels = table([3, 2, 4], 5), 300, 60
    voxel = np.r_[np.arange(voxels), RNG.integers(0, voxels, points - voxels)]
    cell = np.arange(voxels) // 7
    instance = RNG.integers(0, len(log_likelihoods.submaps), points)
    labels, probabilities = _fused_labels(
        voxel, cell, instance, log_likelihoods, *np.zeros((2, voxels, 3))
    )
    store, rows = LabelStoreConfig(), log_likelihoods.log_likelihoods.astype(float)
    for v in range(voxels):
        evidence, misses = np.log(store.prior(5)), 0.0
        for submap in range(3):
            of_submap = log_likelihoods.submaps[instance] == submap
            mine = of_submap & (voxel == v)
            if not mine.any():
                mine = of_submap & (cell[voxel] == cell[v])
            if mine.any():
                evidence += rows[instance[mine]].mean(axis=0)
                misses += np.mean(instance[mine] == log_likelihoods.first[submap])
        evidence[1:] += store.log_missed(np.array(misses))
        share = np.exp(evidence) / np.exp(evidence).sum()
        assert labels[v] == share.argmax()
        assert abs(probabilities[v] - share.max()) < 1e-4


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
        instance = evidence.first + (np.arange(found + missed) < found)
        views = np.zeros(len(instance), np.int64)
        assert _fused_labels(
            views, np.zeros(1, np.int64), instance, evidence, *np.zeros((2, 1, 3))
        )[0] == [label]
        labels = LabelStore(classes, store)
        for k in range(found + missed):
            if k < found:
                labels.update(np.zeros(1, np.int64), distribution[None], np.float32([0.8]))
            else:
                labels.miss(np.zeros(1, np.int64), np.ones(1, np.float32))
        assert labels.estimates(np.zeros(1, np.int64)).labels == [label]


def test_blocks_do_not_share_voxels(tmp_path: Path) -> None:
    far = make_pose(np.eye(3), np.array([BLOCK_VOXELS * VOXEL_M, 0, 0]))
    files = sort_into_blocks(
        [PlacedSubmap(submap(0, instances=1), np.eye(4), 0), PlacedSubmap(submap(1), far, 1)],
        VOXEL_M,
        tmp_path,
    )
    assert len(files) > 2
    points = np.concatenate([c.points for c in merge_blocks(files, VOXEL_M, table([1, 3], 2))])
    assert len(np.unique(np.floor(points / VOXEL_M), axis=0)) == len(points)


def test_files_are_read_back(tmp_path: Path) -> None:
    files = sort_into_blocks([PlacedSubmap(submap(0), np.eye(4), 0)], VOXEL_M, tmp_path)
    (cloud, *rest) = list(merge_blocks(files, VOXEL_M, table([3], 5)))
    with CloudWriter(tmp_path / "cloud") as writer:
        for part in (cloud, *rest):
            writer.write(part)
    columns = read_ply(tmp_path / "cloud.ply")
    assert len(columns["x"]) == writer.count
    np.testing.assert_array_equal(columns["x"][: len(cloud)], cloud.points[:, 0])
    np.testing.assert_array_equal(columns["red"][: len(cloud)], cloud.colours[:, 0])
    io = load_open3d().io
    for name in ("cloud.ply", "cloud.pcd"):
        read = io.read_point_cloud(str(tmp_path / name))
        np.testing.assert_allclose(np.asarray(read.points)[: len(cloud)], cloud.points, atol=1e-6)
        np.testing.assert_allclose(
            255 * np.asarray(read.colors)[: len(cloud)], cloud.colours, atol=0.5
        )
        np.testing.assert_allclose(np.asarray(read.normals)[: len(cloud)], cloud.normals, atol=1e-6)


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
