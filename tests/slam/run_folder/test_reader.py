"""`Run`: every part of a run folder as arrays, of finished runs and of runs that were killed."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence, signal_at, true_pose

from bmask_slam.api import map_run, run
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.ply import read_ply
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.offline import runner
from bmask_slam.offline.options import RunOptions
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.run_folder.covariance_file import COVARIANCES, read_covariances
from bmask_slam.run_folder.reader import Run
from bmask_slam.run_folder.semantic_files import read_labels


@pytest.fixture(scope="module")
def labelled(
    rendered: Callable[[RenderConfig], Path], tmp_path_factory: pytest.TempPathFactory
) -> Run:
    """A short run with exact masks, covariances and a dense map."""
    office = rendered(RenderConfig("office", 16, fps=8.0, width=320, height=240))
    folder = tmp_path_factory.mktemp("reader")
    settings = {
        "covariances": True,
        "semantics.segmenter.min_score": 0.5,
        "features.max_keypoints": 1500,  # enough for the boxes of small objects
    }
    found = run(office, folder / "run", segmenter="truth", settings=settings)
    return map_run(found, voxel_m=0.02)


@pytest.fixture(scope="module")
def fake_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the fake system; frames 6 and 13 are lost."""
    folder = tmp_path_factory.mktemp("fake")
    options = RunOptions(make_sequence(folder / "seq"), out=folder / "run", quiet=True)
    return runner.run(options, FakeSystem).folder


@pytest.fixture
def known(fake_run: Path, tmp_path: Path) -> Run:
    """A copy of `fake_run`, which may be changed."""
    return Run(shutil.copytree(fake_run, tmp_path / "run"))


def test_trajectory_and_keyframes_are_those_of_the_system(known: Run) -> None:
    tracked = [k for k in range(20) if k % 7 != 6]
    np.testing.assert_allclose(known.trajectory.timestamps_s, np.array(tracked) / 10)
    expected = [true_pose(k) for k in tracked]
    np.testing.assert_allclose(known.trajectory.poses_world_camera, expected, atol=1e-8)
    assert known.trajectories == (known.trajectory,)
    assert known.keyframes.ids.tolist() == [0, 1, 2, 3]
    assert known.keyframes.reasons == ("new view",) * 4
    np.testing.assert_allclose(known.keyframes.timestamps_s, [0, 0.5, 1, 1.5])
    np.testing.assert_allclose(known.keyframes.poses_world_camera[2], true_pose(10), atol=1e-8)


def test_frames_have_a_row_each(known: Run) -> None:
    frames = known.frames
    assert len(frames) == 20
    assert [k for k, status in enumerate(frames.status) if status == "LOST"] == [6, 13]
    assert frames.matches.tolist() == list(range(100, 120))
    assert frames.keyframe_ids.tolist() == [k // 5 if k % 5 == 0 else -1 for k in range(20)]
    assert frames.stage_ms["tracking"][3] == 1003.0
    assert np.isnan(frames.stage_ms["loops"]).all()
    assert frames.mostly_moving.dtype == bool


def test_landmarks_without_a_segmenter_have_no_labels(known: Run) -> None:
    landmarks = known.landmarks
    np.testing.assert_allclose(landmarks.points_world, [[1, 2, 3], [-4.5, 5.25, 6]])
    assert landmarks.ids.tolist() == [3, 8]
    assert landmarks.colours.tolist() == [[255, 1, 2], [3, 4, 250]]
    assert (landmarks.labels, landmarks.probabilities, landmarks.entropies) == (None, None, None)


def test_metrics_origin_and_log(known: Run, fake_run: Path) -> None:
    assert known.metrics["tracked_share"] == (pytest.approx(0.9), "1")
    assert known.metrics["keyframes"].unit == "keyframes"
    assert known.sequence == fake_run.with_name("seq")
    assert known.config.tracking.min_inliers > 0
    assert any("camera from" in line for line in known.log)
    assert known.is_finished


def test_a_run_is_a_path(known: Run) -> None:
    assert Path(known) == known.path
    assert repr(known) == f"Run({str(known.path)!r})"
    assert Run(known).path == known.path


def test_each_part_is_read_once(known: Run) -> None:
    trajectory = known.trajectory
    shutil.rmtree(known.path)
    assert known.trajectory is trajectory


def test_labels_are_those_of_the_csv(labelled: Run) -> None:
    table, landmarks = read_labels(labelled.path), labelled.landmarks
    assert landmarks.labels is not None and landmarks.probabilities is not None
    assert landmarks.labels.tolist() == list(table.labels)
    assert {"unknown", "desk"} <= set(landmarks.labels.tolist())
    np.testing.assert_allclose(landmarks.probabilities, table.probability, atol=1e-5)


def test_label_distributions_belong_to_the_landmarks(labelled: Run) -> None:
    p, landmarks = labelled.label_distributions, labelled.landmarks
    assert p.shape == (len(landmarks), len(labelled.label_names))
    np.testing.assert_allclose(p.sum(axis=1), 1)
    np.testing.assert_allclose(p.max(axis=1), landmarks.probabilities, atol=1e-6)
    assert landmarks.labels is not None
    assert np.array(labelled.label_names)[p.argmax(axis=1)].tolist() == landmarks.labels.tolist()


def test_objects_are_near_their_landmarks(labelled: Run) -> None:
    landmarks = labelled.landmarks
    assert {"desk", "screen"} <= {o.label for o in labelled.objects}
    for map_object in labelled.objects:
        points = landmarks.points_world[np.isin(landmarks.ids, map_object.landmarks)]
        distances_m = np.linalg.norm(points - map_object.centroid_world, axis=1)
        assert distances_m.min(initial=0) < 0.5


def test_saved_and_computed_covariances_are_the_same(labelled: Run, tmp_path: Path) -> None:
    saved = read_covariances(labelled.path / COVARIANCES)
    rows = np.searchsorted(saved.keyframe_ids, labelled.keyframes.ids)
    np.testing.assert_allclose(labelled.keyframe_covariances, saved.covariances[rows])
    for name in ("graph", "keyframes.txt", "frames.csv", "config.yaml", "landmarks.ply"):
        shutil.copy(labelled.path / name, tmp_path)
    computed = Run(tmp_path).keyframe_covariances
    np.testing.assert_allclose(computed, labelled.keyframe_covariances, rtol=1e-6, atol=1e-18)


def test_a_singular_graph_has_no_covariances_and_says_so(labelled: Run, monkeypatch) -> None:
    def fail(*_: object) -> None:
        raise SolverError("Indeterminant linear system", ("keyframe", 3))

    monkeypatch.setattr(Smoother, "marginals", fail)
    with pytest.raises(InputError, match=r"graph: no covariances, it is singular \(Indet"):
        _ = Run(labelled.path).landmark_covariances


def test_landmark_covariances_belong_to_the_landmarks(labelled: Run) -> None:
    covariances = labelled.landmark_covariances
    assert covariances.shape == (len(labelled.landmarks), 3, 3)
    known = np.isfinite(covariances).all(axis=(1, 2))
    assert known.mean() > 0.2
    assert (np.linalg.eigvalsh(covariances[known])[:, 0] > 0).all()
    cameras_world = labelled.keyframes.poses_world_camera[:, :3, 3]
    rays = labelled.landmarks.points_world[known] - cameras_world.mean(axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    least_sure = np.linalg.eigh(covariances[known])[1][:, :, -1]  # of others' landmarks: 0.75
    assert np.quantile(np.abs((least_sure * rays).sum(axis=1)), 0.05) > 0.995


def test_dense_clouds(labelled: Run) -> None:
    cloud, columns = labelled.dense_cloud, read_ply(labelled.path / "dense/cloud.ply")
    np.testing.assert_array_equal(cloud.points_world[:, 2], columns["z"])
    np.testing.assert_allclose(np.linalg.norm(cloud.normals_world, axis=1), 1, atol=1e-3)
    assert "desk" in set(cloud.labels.tolist())
    assert (cloud.sigmas_m > 0).all()
    by_id = {o.id: o for o in labelled.objects}
    for number, part in labelled.object_clouds.items():
        assert set(part.labels.tolist()) == {by_id[number].label}
        if len(by_id[number].keyframes) > 1:  # one view's cloud has what its mask shows beside it
            assert by_id[number].box.contains(part.points_world).mean() > 0.8


def test_the_camera_is_that_of_the_sequence(labelled: Run) -> None:
    assert (labelled.camera.width, labelled.camera.height) == (320, 240)


# --- What is not there, or not whole -------------------------------------------------------------


def killed(tmp_path: Path, **options: int) -> Run:
    """The folder of a run that is killed after frame 41."""

    class KilledError(Exception):
        pass

    def kill(k: int) -> None:
        if k == 41:
            raise KilledError

    sequence = make_sequence(tmp_path / "seq", 50)
    made = RunOptions(sequence, out=tmp_path / "run", quiet=True, **options)
    with pytest.raises(KilledError):
        runner.run(made, partial(FakeSystem, on_frame=kill))
    return Run(tmp_path / "run")


@pytest.mark.parametrize("every", [None, 10])
def test_a_run_that_was_stopped_is_not_finished(tmp_path: Path, every: int | None) -> None:
    sequence, out = make_sequence(tmp_path / "seq", 20), tmp_path / "run"
    made = RunOptions(sequence, out=out, checkpoint_every=every, quiet=True)
    stopped = partial(FakeSystem, on_frame=signal_at(12, signal.SIGINT))
    assert runner.run(made, stopped).stopped_by is not None
    assert not Run(out).is_finished
    assert Run(out).metrics["stopped_after"] == (13, "frames")
    if every is None:
        with pytest.raises(InputError, match="holds no checkpoint, so there is nothing to resume"):
            runner.resume(out, make_system=FakeSystem)
    else:
        runner.resume(out, make_system=FakeSystem)
        assert Run(out).is_finished and "stopped_after" not in Run(out).metrics


def test_a_killed_run_gives_its_written_parts(tmp_path: Path) -> None:
    found = killed(tmp_path)
    assert not found.is_finished
    assert len(found.frames) == 41
    assert len(found.trajectory) == 36
    assert found.config.tracking.min_inliers > 0
    again = rf"make it by: bmask-slam run {tmp_path}/seq --out {tmp_path}/run --overwrite"
    for part in ("keyframes", "landmarks", "metrics", "camera", "label_distributions"):
        with pytest.raises(InputError, match=rf"run/[\w.]+: no such file; {again}"):
            getattr(found, part)


def test_a_killed_run_with_a_checkpoint_can_be_finished(tmp_path: Path) -> None:
    found = killed(tmp_path, checkpoint_every=10)
    cure = rf"finish the run by: bmask-slam run --resume {tmp_path}/run"
    with pytest.raises(InputError, match=rf"landmarks\.ply: no such file yet; {cure}"):
        _ = found.landmarks


def test_a_command_in_a_message_can_be_pasted_into_a_shell(tmp_path: Path) -> None:
    (folder := tmp_path / "a room; ls").mkdir()
    out = f"--out '{tmp_path}/a room; ls"
    with pytest.raises(InputError, match=re.escape(f"bmask-slam run SEQUENCE {out}'")):
        Run(folder)
    found = killed(folder)
    again = f"make it by: bmask-slam run '{folder}/seq' {out}/run' --overwrite"
    with pytest.raises(InputError, match=re.escape(again)):
        _ = found.landmarks
    with pytest.raises(InputError, match=re.escape(f"by: bmask-slam map '{folder}/run'")):
        _ = found.dense_cloud


def test_an_incomplete_last_line_of_frames_is_skipped(known: Run) -> None:
    path = known.path / "frames.csv"
    os.truncate(path, path.stat().st_size - 7)
    assert len(known.frames) == 19


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("objects", r"objects\.json: no such file; make it by: .* --segmenter light --out"),
        ("label_names", r"objects\.json: no such file"),
        ("dense_cloud", r"dense/cloud\.ply: no such file; make it by: bmask-slam map"),
        ("object_clouds", r"make it by: bmask-slam map"),
    ],
)
def test_a_missing_part_names_the_command_that_makes_it(
    known: Run, part: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        getattr(known, part)


@pytest.mark.parametrize(
    ("part", "name", "text", "message"),
    [
        ("metrics", "metrics.json", "[{}]", r"metrics\.json: 0\.name: field req.*; make it"),
        ("frames", "frames.csv", "index,timestamp\n", r"frames\.csv: no column status; run again"),
        ("frames", "frames.csv", None, r"frames\.csv: a line with too few or too many values"),
        ("trajectory", "trajectory.txt", "0 0 0 nan 0 0 0 1\n", r"trajectory\.txt"),
        ("landmarks", "landmarks.ply", "ply\n", r"landmarks\.ply: not a PLY file"),
    ],
)
def test_a_broken_part_is_named(
    known: Run, part: str, name: str, text: str | None, message: str
) -> None:
    path = known.path / name
    path.write_text(path.read_text().replace("OK,", "", 1) if text is None else text)
    with pytest.raises(InputError, match=message):
        getattr(known, part)


def test_a_label_without_a_name_is_refused(labelled: Run, tmp_path: Path) -> None:
    shutil.copy(labelled.path / "landmarks.ply", tmp_path)
    (tmp_path / "objects.json").write_text(json.dumps({"labels": ["unknown"], "objects": []}))
    with pytest.raises(InputError, match=r"landmarks\.ply: a label beyond the 1 of the run"):
        _ = Run(tmp_path).landmarks


def test_other_folders_than_runs_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nowhere: no such folder; give the folder of a run"):
        Run(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no run; make one by: bmask-slam run SEQUENCE"):
        Run(tmp_path)
