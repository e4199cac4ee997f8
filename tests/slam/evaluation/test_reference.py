"""Reference poses of another body than the camera: Bonn's markers, and what a file tells."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest
from repository import shared
from small_layouts import POSES, SMALL_LAYOUTS, write_small

from bmask_slam.calibration import calibrate
from bmask_slam.evaluation import evaluate, read_reference
from bmask_slam.evaluation.reference import BONN, MARKERS, TRUTH, TRUTH_BODY, TruthBody
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.graph.trajectory import Trajectory, read_tum, write_tum
from bmask_slam.offline.runner import find_reference
from bmask_slam.sequences.formats.convert import convert
from bmask_slam.sequences.sequence import open_sequence

T_ROS = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
T_M = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)
T_CAMERA_BODY = se3_exp(np.array([0.3, -0.2, 0.5, 0.2, -0.1, 0.4]))


def write_body(parent: Path, name: str, body: TruthBody) -> Path:
    """A small sequence whose groundtruth.txt has the poses of a body, its camera those of POSES."""
    made = write_small(SMALL_LAYOUTS[0], parent)
    folder = made.rename(parent / name)
    given = [inverse(body.T_world_given) @ T @ inverse(body.T_body_camera) for T in POSES]
    write_tum(folder / TRUTH, Trajectory(read_tum(folder / TRUTH).timestamps_s, np.array(given)))
    return folder


def check(truth: Trajectory | None) -> None:
    assert truth is not None
    assert np.allclose(truth.poses_world_camera, POSES, atol=1e-5)


def test_bonns_markers_are_converted_as_its_page_says() -> None:
    T = se3_exp(np.array([0.4, -0.3, 1.2, 1.0, 2.0, 3.0]))
    found = BONN.camera_of(Trajectory(np.array([1.0]), T[None])).poses_world_camera[0]
    published = T_ROS @ T @ T_ROS @ T_M  # with a scale in the rotation, which no pose has
    assert np.allclose(found[:3, 3], published[:3, 3], atol=1e-9)
    scale = np.cbrt(np.linalg.det(T_M[:3, :3]))
    assert np.allclose(found[:3, :3], published[:3, :3] / scale, atol=1e-4)
    assert np.allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-8)
    assert scale == pytest.approx(1.059, abs=1e-3)


def test_the_excerpts_markers_become_its_camera() -> None:
    folder = shared("bonn_crowd")
    found = BONN.camera_of(read_tum(folder / "groundtruth_markers.txt"))
    expected = read_reference(folder)  # of the camera already: its name is not as published
    assert np.allclose(found.poses_world_camera, expected.poses_world_camera, atol=5e-6)


def test_a_folder_of_bonn_is_known_by_its_name(tmp_path: Path, caplog, monkeypatch) -> None:
    folder = write_body(tmp_path, "rgbd_bonn_crowd2", BONN)
    with caplog.at_level(logging.INFO):
        sequence = open_sequence(folder)
    check(sequence.groundtruth)
    said = "poses of another body, converted to the camera's by the folder's name: Bonn's markers"
    assert caplog.text.count(said) == 1
    for path in (folder, folder / TRUTH):
        check(read_reference(path))
        check(find_reference(path, sequence))
    write_tum(tmp_path / "trajectory.txt", Trajectory(sequence.groundtruth.timestamps_s, POSES))
    assert evaluate(tmp_path / "trajectory.txt", folder).value("ate_rmse") < 1e-5
    monkeypatch.setattr(calibrate, "MIN_REFERENCE_POSES", 3)
    positions, _ = calibrate._reference_positions(folder, sequence.timestamps_s, np.array(POSES))
    assert np.allclose(positions, np.array(POSES)[:, :3, 3], atol=1e-5)


def test_a_folder_of_bonn_that_keeps_its_markers_is_converted_already(tmp_path: Path) -> None:
    folder = write_body(tmp_path, "rgbd_bonn_crowd2", TruthBody())
    (folder / MARKERS).write_text("# as published\n")
    check(read_reference(folder))
    (folder / MARKERS).unlink()
    assert not np.allclose(read_reference(folder).poses_world_camera, POSES, atol=0.1)


def test_other_names_are_of_the_camera(tmp_path: Path) -> None:
    for name in ("bonn_crowd", "rgbd_bonn", "my_rgbd_bonn_crowd"):
        check(open_sequence(write_body(tmp_path, name, TruthBody())).groundtruth)
    folder = write_body(tmp_path, "rgbd_bonn_crowd", TruthBody())
    assert not np.allclose(read_reference(folder).poses_world_camera, POSES, atol=0.01)
    (folder / TRUTH_BODY).write_text(TruthBody().yaml())  # converted already
    check(open_sequence(folder).groundtruth)


def test_a_file_tells_where_another_body_is(tmp_path: Path, caplog) -> None:
    body = TruthBody(inverse(T_CAMERA_BODY), se3_exp(np.array([0.1, 0.2, 0.3, 1, 2, 3])))
    folder = write_body(tmp_path, "lab", body)
    numbers = inverse(T_CAMERA_BODY).round(4).ravel().tolist()
    (folder / TRUTH_BODY).write_text(f"T_body_camera: {numbers}\n")
    with caplog.at_level(logging.INFO):
        turned = open_sequence(folder).groundtruth.poses_world_camera
    assert "converted to the camera's by groundtruth.yaml" in caplog.text
    expected = inverse(body.T_world_given) @ np.array(POSES)  # in the frame of the file
    assert np.allclose(turned, expected, atol=1e-3)
    (folder / TRUTH_BODY).write_text(body.yaml())
    check(open_sequence(folder).groundtruth)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[1, 2]", "the keys are T_body_camera"),
        ("T_camera_body: [1]", "the keys are T_body_camera"),
        ("T_body_camera: [1, 2]", "T_body_camera is not 16 numbers"),
        ("T_body_camera: [a, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "is not 16 numbers"),
        ("T_body_camera: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "is no rotation"),
        ("T_body_camera: [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "is no rotation"),
        ("T_body_camera: [.nan, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]", "is no rotation"),
    ],
)
def test_a_broken_file_is_refused(text: str, reason: str, tmp_path: Path) -> None:
    folder = write_body(tmp_path, "lab", TruthBody())
    (folder / TRUTH_BODY).write_text(text)
    with pytest.raises(InputError, match=rf"groundtruth\.yaml: .*{reason}.*; write T_body_camera"):
        open_sequence(folder)


@pytest.mark.parametrize("name", ["plain", "rgbd_bonn_converted"])
def test_converted_poses_are_not_converted_again(name: str, tmp_path: Path) -> None:
    source, out = write_body(tmp_path, "rgbd_bonn_crowd", BONN), tmp_path / name
    convert(source, out)
    check(open_sequence(out).groundtruth)
    check(open_sequence(out.rename(tmp_path / "rgbd_bonn_moved")).groundtruth)
