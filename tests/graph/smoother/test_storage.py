"""A saved graph is read back completely; damaged files and those of others are rejected."""

import json
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_room import CAMERA, make_room

from bmask_slam.graph.camera import DepthNoise
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.graph_update import GraphUpdate, RelativePose
from bmask_slam.graph.geometry import inverse
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.graph.smoother.storage import read_graph

ROOM = make_room(keyframes=8, noise_px=0.4, mono_share=0.2)


@pytest.fixture
def smoother() -> Smoother:
    smoother = Smoother(CAMERA)
    for update in ROOM.updates()[:6]:
        smoother.update(update)
    poses = ROOM.poses_world_camera
    loop = RelativePose(
        0, 5, inverse(poses[0]) @ poses[5], 1e-4 * np.eye(6), robust="dcs", kind="loop"
    )
    smoother.update(
        GraphUpdate(
            relative_poses=(loop,),
            remove_landmarks=np.array([4]),
            remove_keyframes=np.array([2]),
        )
    )
    return smoother


def test_a_loaded_graph_equals_the_saved_one(smoother: Smoother, tmp_path: Path) -> None:
    smoother.save(tmp_path / "graph")
    loaded = Smoother.load(tmp_path / "graph")
    before, after = smoother.estimate(), loaded.estimate()
    assert after.factors == before.factors
    np.testing.assert_array_equal(after.keyframe_ids, before.keyframe_ids)
    np.testing.assert_array_equal(after.poses_world_camera, before.poses_world_camera)
    np.testing.assert_array_equal(after.landmark_ids, before.landmark_ids)
    np.testing.assert_array_equal(after.points_world, before.points_world)
    loaded.save(tmp_path / "again")
    assert (tmp_path / "graph").read_bytes() == (tmp_path / "again").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again", "graph"]
    first, second = smoother.optimise_batch(), loaded.optimise_batch()
    np.testing.assert_array_equal(first.poses_world_camera, second.poses_world_camera)
    assert first.cost_after == second.cost_after


def test_a_loaded_run_continues_like_a_restarted_one(smoother: Smoother, tmp_path: Path) -> None:
    smoother.save(tmp_path / "graph")
    smoother.restart()
    loaded = Smoother.load(tmp_path / "graph")
    rest = [*ROOM.updates()[6:], GraphUpdate(remove_landmarks=np.array([9]))]
    for update in rest:
        undisturbed, resumed = smoother.update(update), loaded.update(update)
        np.testing.assert_array_equal(undisturbed.points_world, resumed.points_world)
        np.testing.assert_array_equal(undisturbed.poses_world_camera, resumed.poses_world_camera)
    assert undisturbed.keyframe_ids.tolist() == [0, 1, 3, 4, 5, 6, 7]


def test_a_loop_of_a_loaded_graph_is_removed_by_name(smoother: Smoother, tmp_path: Path) -> None:
    smoother.save(tmp_path / "graph")
    loaded = Smoother.load(tmp_path / "graph")
    before = loaded.estimate().factors
    after = loaded.update(GraphUpdate(remove_relative_poses=((0, 5, "loop"),)))
    assert after.factors == before - 1


def test_an_empty_graph_is_saved_too(tmp_path: Path) -> None:
    Smoother(CAMERA).save(tmp_path / "graph")
    loaded = Smoother.load(tmp_path / "graph")
    for update in ROOM.updates():
        estimate = loaded.update(update)
    assert len(estimate.keyframe_ids) == 8


def test_a_camera_that_cannot_be_is_refused_with_its_file(tmp_path: Path) -> None:
    camera = replace(CAMERA)
    object.__setattr__(camera, "fx", -500.0)
    Smoother(camera).save(tmp_path / "graph")
    words = r"graph: its camera: a focal length.* of -500, which is not positive.*save it again"
    with pytest.raises(InputError, match=words):
        read_graph(tmp_path / "graph")


def test_the_depth_noise_of_the_camera_is_saved(tmp_path: Path) -> None:
    camera = replace(CAMERA, depth_noise=DepthNoise(0.001, 0.0, 0.002))
    Smoother(camera).save(tmp_path / "graph")
    assert read_graph(tmp_path / "graph")[1] == camera


@pytest.mark.parametrize("cut", [0, 10, 1000, -30])
def test_a_damaged_file_is_refused_by_name(smoother: Smoother, tmp_path: Path, cut: int) -> None:
    path = tmp_path / "graph"
    smoother.save(path)
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match=str(path)):
        Smoother.load(path)


def test_missing_foreign_and_newer_files_are_refused(smoother: Smoother, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no saved graph"):
        Smoother.load(tmp_path / "nowhere")
    (tmp_path / "text").write_text("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1")
    with pytest.raises(InputError, match="not a saved graph"):
        Smoother.load(tmp_path / "text")
    with pytest.raises(InputError, match="not a saved graph"):
        np.savez(tmp_path / "other.npz", a=np.zeros(3))
        Smoother.load(tmp_path / "other.npz")
    arrays = saved_arrays(smoother, tmp_path)
    header = json.loads(str(arrays["header"]))
    arrays["header"] = np.array(json.dumps({**header, "version": 99}))
    with pytest.raises(InputError, match="version 99"):
        load(arrays, tmp_path)


@pytest.mark.parametrize(
    ("name", "spoil", "word"),
    [
        ("measurements", lambda a: a[:-1], "rows"),
        ("points_world", lambda a: a[:, :2], "misshapen"),
        ("landmark_ids", lambda a: a[::-1].copy(), "ascending"),
        ("observation_landmark_ids", lambda a: a + 100000, "unknown id"),
        ("pose_factor_keyframes", lambda a: a + 100000, "unknown id"),
    ],
)
def test_inconsistent_contents_are_rejected(
    smoother: Smoother, tmp_path: Path, name: str, spoil: object, word: str
) -> None:
    arrays = saved_arrays(smoother, tmp_path)
    arrays[name] = spoil(arrays[name])
    with pytest.raises(InputError, match=word):
        load(arrays, tmp_path)


def with_first(value: float) -> Callable[[np.ndarray], np.ndarray]:
    """An array with another value in its first row."""

    def spoil(array: np.ndarray) -> np.ndarray:
        spoilt = array.copy()
        spoilt[0] = value
        return spoilt

    return spoil


@pytest.mark.parametrize(
    ("name", "spoil"),
    [
        ("pose_factor_robust", lambda a: np.full(len(a), "tukey")),
        ("pose_factor_covariances", lambda a: -a),
        ("pose_factor_covariances", with_first(np.nan)),
        ("pose_factor_T", with_first(np.inf)),
        ("poses_world_camera", with_first(np.nan)),
        ("poses_world_camera", lambda a: a.astype(str)),
        ("points_world", with_first(np.inf)),
        ("points_world", lambda a: a.astype(np.float32)),
        ("measurements", with_first(np.nan)),
        ("sigmas_px", with_first(0.0)),
        ("landmark_ids", lambda a: a.astype(float)),
    ],
)
def test_values_that_no_graph_has_are_rejected(
    smoother: Smoother, tmp_path: Path, name: str, spoil: Callable[[np.ndarray], np.ndarray]
) -> None:
    """They would end in an exception of GTSAM or numpy, or in values that are not finite."""
    arrays = saved_arrays(smoother, tmp_path)
    arrays[name] = spoil(arrays[name])
    with pytest.raises(InputError, match=f"graph: array '{name}'"):
        load(arrays, tmp_path)


def test_ids_that_no_graph_has_are_rejected(smoother: Smoother, tmp_path: Path) -> None:
    arrays = saved_arrays(smoother, tmp_path)
    for name in ("landmark_ids", "observation_landmark_ids"):
        arrays[name] = arrays[name] + 2**62
    with pytest.raises(InputError, match="array 'landmark_ids'"):
        load(arrays, tmp_path)


def saved_arrays(smoother: Smoother, folder: Path) -> dict[str, np.ndarray]:
    smoother.save(folder / "graph")
    with np.load(folder / "graph") as file:
        return {key: file[key] for key in file.files}


def load(arrays: dict[str, np.ndarray], folder: Path) -> Smoother:
    with (folder / "graph").open("wb") as file:
        np.savez(file, **arrays)
    return Smoother.load(folder / "graph")


def test_a_folder_that_does_not_exist_is_an_input_error(smoother: Smoother, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be written"):
        smoother.save(tmp_path / "missing" / "graph")


def test_updates_and_estimates_can_be_pickled() -> None:
    update = ROOM.update_of(1)
    copy = pickle.loads(pickle.dumps(update))
    np.testing.assert_array_equal(copy.observations.measurements, update.observations.measurements)
    smoother = Smoother(CAMERA)
    estimate = smoother.update(ROOM.update_of(0))
    assert pickle.loads(pickle.dumps(estimate)).factors == estimate.factors


def test_front_end_modules_import_without_gtsam() -> None:
    """Updates are made, checked and saved with numpy only; a process needs no GTSAM for it."""
    modules = (
        *("factors.graph_update", "factors.graph_estimate", "factors.factor_tables"),
        *("factors.checks", "factors.observability", "factors.smoother_config"),
        *("smoother.validation", "smoother.removal", "smoother.storage"),
    )
    imports = ", ".join(f"bmask_slam.graph.{module}" for module in modules)
    code = f"import sys, {imports}; sys.exit('gtsam' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
