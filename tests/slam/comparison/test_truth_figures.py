"""Labels and depth against the rendered truth, in another world frame."""

from __future__ import annotations

import csv
import json

import cv2
import numpy as np
import pytest

from bmask_slam.comparison.jobs.truth_figures import (
    depth_ratio,
    label_accuracy,
    true_classes,
    true_depth,
    truth_from_world,
    visible,
)
from bmask_slam.graph.files.ply import write_ply
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.trajectory import write_tum
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.rendering.annotations import CLASSES
from bmask_slam.semantics.labels import label_set
from bmask_slam.sequences.sequence import open_sequence

T_WORLD_TRUTH = se3_exp([0.4, -1.1, 0.3, 2.0, -3.0, 1.0])
NAMES = label_set(CLASSES)
WRONG = 4  # every fourth label


@pytest.fixture
def run(office, tmp_path):
    """A run office whose landmarks are pixels of the first frame, labelled right but for some."""
    sequence = open_sequence(office)
    truth = sequence.groundtruth
    write_tum(tmp_path / "keyframes.txt", truth.moved(T_WORLD_TRUTH))
    (tmp_path / "config.yaml").write_text("semantics: {segmenter: {name: truth}}\n")
    depth_m = true_depth(sequence, 0)
    rows, columns = np.mgrid[2:118:3, 2:158:3].reshape(2, -1)
    known = np.isfinite(depth_m[rows, columns])
    rows, columns = rows[known], columns[known]
    camera, z = sequence.camera, depth_m[rows, columns]
    points = np.column_stack(
        [(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z]
    )
    points = transform(T_WORLD_TRUTH @ truth.poses_world_camera[0], points)
    file = office / "instances" / sequence.pairs.rgb_files[0].name
    instances = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[rows, columns]
    labels = [
        NAMES.map_name(k) for k in true_classes(office, NAMES)[instances.astype(int)].tolist()
    ]
    labels = ["umbrella" if k % WRONG == 0 else name for k, name in enumerate(labels)]
    columns = dict(zip("xyz", points.T.astype(np.float32), strict=True))
    write_ply(tmp_path / "landmarks.ply", columns | {"id": np.arange(len(points), dtype=np.int32)})
    with (tmp_path / "labels.csv").open("w", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(("id", "label", "probability", "entropy", "views"))
        writer.writerows((k, name, 1, 0, 3) for k, name in enumerate(labels))
    return tmp_path


def test_labels_in_another_world(run, office):
    """Three of four are right, except for some landmarks at edges."""
    assert label_accuracy(run, open_sequence(office)) == pytest.approx(1 - 1 / WRONG, abs=0.03)


def test_labels_in_a_wrong_world_are_wrong(run, office):
    """Keyframe poses that do not fit to the landmarks."""
    sequence = open_sequence(office)
    moved = sequence.groundtruth.moved(T_WORLD_TRUTH @ se3_exp([0, 0.5, 0, 0, 0, 0]))
    write_tum(run / "keyframes.txt", moved)
    found = label_accuracy(run, sequence)
    assert found is None or found < 0.6


def test_a_run_without_labels_has_no_figure(run, office):
    (run / "labels.csv").unlink()
    assert label_accuracy(run, open_sequence(office)) is None
    assert depth_ratio(run, open_sequence(office)) is None


def test_the_mean_transform(office):
    truth = open_sequence(office).groundtruth
    found = truth_from_world(
        truth.moved(T_WORLD_TRUTH).poses_world_camera, truth.poses_world_camera
    )
    np.testing.assert_allclose(found, inverse(T_WORLD_TRUTH), atol=1e-9)


def test_hidden_points_are_not_visible(office):
    camera = open_sequence(office).camera
    depth_m = np.full((camera.height, camera.width), 2.0)
    points = np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 1.0], [0, 0, -2.0], [9, 0, 2.0]])
    rows, pixels = visible(points, depth_m, camera)
    assert rows.tolist() == [0]
    assert pixels.tolist() == [[round(camera.cx), round(camera.cy)]]


def test_depth_against_the_sensor(run, office, monkeypatch):
    """A map that halves the sensor's error gives one half; NaN and outliers do not count."""
    sequence = open_sequence(office)
    (run / "frames.csv").write_text(
        "index,timestamp,status,keyframe\n0,0,OK,0\n1,1,OK,\n2,2,OK,1\n"
    )
    (run / "dense").mkdir()
    (run / "dense/dense.json").write_text(json.dumps({}))

    class Dense:
        def is_done(self, keyframe):
            return keyframe < 2

        def fused(self, keyframe):
            index = 2 * keyframe
            exact, sensor = true_depth(sequence, index), sequence.load(index).depth_m
            depth_m = exact + (sensor - exact) / 2
            depth_m[:20] = np.nan
            depth_m[20:30] = 9.0
            return Fixed(depth_m)

    class Fixed(InverseDepthMap):
        def __init__(self, depth_m):
            object.__setattr__(self, "given", depth_m)

        def depth_m(self):
            return self.given

    monkeypatch.setattr(
        "bmask_slam.comparison.jobs.truth_figures.DenseFolder.open", lambda run: Dense()
    )
    assert depth_ratio(run, sequence) == pytest.approx(0.5, rel=1e-6)
