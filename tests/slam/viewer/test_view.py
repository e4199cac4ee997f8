"""Data sent to Rerun, read back from the recording."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from fake_run import FakeSystem, make_sequence
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from synthetic_view import CAMERA, PlaneViews, make_features

from bmask_slam.cli import main
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.trajectory import read_tum
from bmask_slam.live.display import Display
from bmask_slam.live.live_slam import LiveOptions, LiveSlam
from bmask_slam.live.processes.dense_messages import Preview
from bmask_slam.offline import runner
from bmask_slam.offline.options import RunOptions
from bmask_slam.run_folder.frame_file import read_frames
from bmask_slam.semantics.objects.boxes3d import OrientedBox
from bmask_slam.sequences.cameras import read_camera
from bmask_slam.tracking.results import FrameResult, TrackingStatus
from bmask_slam.viewer.replay_pictures import ReplayPictures
from bmask_slam.viewer.scene import Scene, ViewOptions
from bmask_slam.viewer.shown import ENLARGED, Box, Ellipsoid
from bmask_slam.world.world_map import WorldMap

RrdReader = pytest.importorskip("rerun.chunk").RrdReader
POSES = [se3_exp(np.array([0, 0, 0, 0.02 * k, 0, 0])) for k in range(12)]
NO_FEATURES = make_features(np.eye(4), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
FRAMES = PlaneViews(POSES)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    """A live run with its recording, and a replay of it."""
    folder = tmp_path_factory.mktemp("view")
    view = ViewOptions(record=folder / "live.rrd")
    with LiveSlam(CAMERA, options=LiveOptions(folder / "run", view=view, dense=True)) as slam:
        for frame in FRAMES:
            slam.track(frame.timestamp_s, frame.rgb, frame.depth_m)
    assert main(["view", str(folder / "run"), "--record", str(folder / "replay.rrd")]) == 0
    return folder


def entities(path: Path) -> dict[str, int]:
    """Rows by entity path of a recording."""
    found: dict[str, int] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        name = str(chunk.entity_path)
        found[name] = found.get(name, 0) + chunk.num_rows
    return found


@pytest.mark.parametrize("name", ["live.rrd", "replay.rrd"])
def test_the_recording_contains_camera_map_and_plots(recorded, name) -> None:
    rows = entities(recorded / name)
    assert rows["/world/camera"] == len(FRAMES)
    assert rows["/plots/status/status"] == len(FRAMES)
    for path in ("/world/landmarks", "/world/keyframes", "/world/camera/image"):
        assert rows[path] >= 1, path
    assert rows["/world/submaps/0" if name == "live.rrd" else "/world/dense"] >= 1
    assert any("/world/surface/" in path for path in rows) == (name == "live.rrd")


def test_without_rerun_the_error_names_the_package(monkeypatch, tmp_path) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"pip install 'bmask-slam\[view\]'"):
        Scene("a", ViewOptions(record=tmp_path / "a.rrd"))


def test_a_recording_in_a_missing_folder_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        Scene("a", ViewOptions(record=tmp_path / "none" / "a.rrd"))


def test_a_recording_that_is_a_folder_is_refused(tmp_path) -> None:
    for options in (ViewOptions(record=tmp_path), ViewOptions(foxglove_file=tmp_path)):
        with pytest.raises(InputError, match="is a folder"):
            Scene("a", options)


@pytest.mark.skipif(sys.platform != "linux", reason="a folder in which nobody may write")
def test_a_recording_that_cannot_be_written_is_refused() -> None:
    with pytest.raises(InputError, match=r"^/proc/run\.rrd: .*; change the folder's permissions"):
        Scene("test", ViewOptions(record=Path("/proc/run.rrd")))


def test_what_cannot_be_shown_leaves_an_earlier_recording(tmp_path, capsys) -> None:
    file = tmp_path / "a.rrd"
    file.write_text("precious")
    assert main(["view", str(tmp_path / "nowhere"), "--record", str(file)]) == 1
    assert "nowhere: " in capsys.readouterr().err
    assert file.read_text() == "precious"


def test_a_window_without_its_program_is_one_line(monkeypatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match=r"window does not open .*--record"):
        Scene("a", ViewOptions(window=True))


def test_a_stamp_that_is_no_time_is_one_line(recorded: Path, tmp_path: Path, capsys) -> None:
    run = shutil.copytree(recorded / "run", tmp_path / "run")
    lines = (run / "frames.csv").read_text().splitlines()
    lines[4] = ",".join(["3", "nan", *lines[4].split(",")[2:]])
    (run / "frames.csv").write_text("\n".join(lines) + "\n")
    assert main(["view", str(run), "--record", str(tmp_path / "a.rrd")]) == 1
    assert f"{run / 'frames.csv'}: a stamp is not a finite number; run" in capsys.readouterr().err


def test_a_run_whose_masks_lack_images_is_shown_without_them(tmp_path, caplog) -> None:
    sequence = make_sequence(tmp_path / "seq")
    run = runner.run(RunOptions(sequence, out=tmp_path / "run", quiet=True), FakeSystem).folder
    other = {"id": 1, "file_name": "rgb/other.png", "width": 8, "height": 8}
    content = {"images": [other], "annotations": [], "categories": [{"id": 1, "name": "cup"}]}
    (tmp_path / "masks.json").write_text(json.dumps(content))
    segmenter = f"{{name: precomputed, masks: {tmp_path / 'masks.json'}}}"
    (run / "config.yaml").write_text(f"semantics: {{segmenter: {segmenter}}}")
    frames, scene = read_frames(run / "frames.csv"), Scene("a", ViewOptions(tmp_path / "a.rrd"))
    camera = read_camera(sequence / "camera.yaml")
    pictures = ReplayPictures(run, sequence, frames, camera)
    assert pictures.names == ("background", "cup")
    for line, stamp_s in enumerate(frames.timestamps_s.tolist()):
        pictures.show(line, stamp_s, scene)
    scene.close()
    assert "shown without masks" in caplog.text
    assert entities(tmp_path / "a.rrd")["/world/camera/image"] == len(frames)


def test_a_run_that_was_localised_in_a_map_is_shown_in_it(recorded, tmp_path: Path) -> None:
    """Without graph and keyframes: its path, the map's landmarks, and the images."""
    options = RunOptions(make_sequence(tmp_path / "seq"), out=tmp_path / "run", quiet=True)
    run = runner.run(options, FakeSystem).folder
    (run / "graph").unlink()
    (run / "map").unlink()
    (run / "keyframes.txt").write_text("# timestamp_s tx ty tz qx qy qz qw\n")
    shutil.copy(recorded / "run" / "landmarks.ply", run)
    assert main(["view", str(run), "--record", str(tmp_path / "a.rrd")]) == 0
    rows = entities(tmp_path / "a.rrd")
    assert rows["/world/camera"] == len(read_tum(run / "trajectory.txt"))
    assert rows["/plots/status/status"] == len(read_frames(run / "frames.csv"))
    for path in ("/world/landmarks", "/world/trajectory", "/world/camera/image"):
        assert rows[path] >= 1, path


def columns(path: Path, entity: str, name: str) -> list[NDArray[Any]]:
    """Rows of one component of an entity in a recording."""
    found = []
    for chunk in RrdReader(path).stream().to_chunks():
        if str(chunk.entity_path) != entity:
            continue
        batch = chunk.to_record_batch()
        for k, field in enumerate(batch.schema):
            if field.name.endswith(name):
                rows = [row for row in batch.column(k).to_pylist() if row]
                found += [np.array(row) for row in rows]
    return found


def test_submaps_are_at_their_keyframes_and_move_with_them(tmp_path) -> None:
    scene = Scene("a", ViewOptions(record=tmp_path / "a.rrd"))
    display, world = Display(scene), WorldMap()
    world.keyframes = {
        k: SimpleNamespace(segment=k // 2, T_world_camera=POSES[k]) for k in range(3)
    }
    points = np.arange(12, dtype=np.float32).reshape(4, 3)
    previews = {k: Preview(points, np.full((4, 3), 9, np.uint8)) for k in range(3)}
    dense = SimpleNamespace(previews=previews)
    display.submaps(dense, world, True, 1)
    display.submaps(dense, world, False, 1)
    assert list(previews) == [2]  # its keyframe is in another map segment
    world.keyframes[0].T_world_camera = POSES[9]
    world.keyframes[1].T_world_camera = POSES[1] @ se3_exp(np.full(6, 1e-5))
    display.submaps(dense, world, True, 5)
    del world.keyframes[1]
    display.submaps(dense, world, True, 5)
    scene.close()
    moves = columns(tmp_path / "a.rrd", "/world/submaps/0", "Transform3D:translation")
    expected = [POSES[0][:3, 3], POSES[9][:3, 3]]
    np.testing.assert_allclose(np.ravel(moves).reshape(-1, 3), expected, atol=1e-6)
    still = columns(tmp_path / "a.rrd", "/world/submaps/1", "Transform3D:translation")
    np.testing.assert_allclose(np.ravel(still), POSES[1][:3, 3], atol=1e-6)
    shown = columns(tmp_path / "a.rrd", "/world/submaps/0", "Points3D:positions")
    np.testing.assert_allclose(shown[0].reshape(-1, 3), points)
    assert columns(tmp_path / "a.rrd", "/world/submaps/1", "Clear:is_recursive")
    assert not columns(tmp_path / "a.rrd", "/world/submaps/2", "Points3D:positions")


def shapes(path: Path, entity: str, kind: str) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Centres (N, 3), rotations (N, 3, 3) and half sizes (N, 3) of what an entity showed first."""
    parts = ("centers", "quaternions", "half_sizes")
    centres, quaternions, half_sizes = (columns(path, entity, f"{kind}:{n}")[0] for n in parts)
    return centres, Rotation.from_quat(quaternions).as_matrix(), half_sizes


def test_objects_have_boxes_and_names(tmp_path: Path) -> None:
    path, T = tmp_path / "a.rrd", [se3_exp(np.array([0.3, 0.5, -0.2, k, 2.0, 3.0])) for k in (1, 4)]
    sizes = [np.array([0.2, 0.4, 0.6]), np.array([1.0, 0.8, 0.1])]
    texts, colours = ["chair 0.90", "desk 0.70"], np.array([[9, 8, 7], [200, 0, 3]], np.uint8)
    boxes = map(OrientedBox, T, sizes)
    scene = Scene("a", ViewOptions(record=path))
    scene.log_boxes(list(map(Box, boxes, texts, colours)))
    scene.close()
    centres, rotations, half_sizes = shapes(path, "/world/objects", "Boxes3D")
    np.testing.assert_allclose(centres, [one[:3, 3] for one in T], atol=1e-6)
    np.testing.assert_allclose(rotations, [one[:3, :3] for one in T], atol=1e-6)
    np.testing.assert_allclose(half_sizes, np.array(sizes) / 2, atol=1e-6)
    assert columns(path, "/world/objects", "Boxes3D:labels")[0].tolist() == texts
    assert columns(path, "/world/objects", "Boxes3D:show_labels")[0].all()
    shown = columns(path, "/world/objects", "Boxes3D:colors")[0]
    assert (shown >> 8).tolist() == [(r << 16) + (g << 8) + b for r, g, b in colours.tolist()]


def test_ellipsoids_are_those_of_the_covariances(tmp_path: Path) -> None:
    """Of keyframes in the world, and of the camera in itself; 3 sigma, enlarged."""
    path, rng = tmp_path / "a.rrd", np.random.default_rng(3)
    factors = rng.normal(0, 0.003, (3, 3, 3))
    covariances, centres = factors @ factors.mT + 1e-7 * np.eye(3), rng.normal(size=(3, 3))
    whole = np.diag([1e-4] * 6)
    whole[3:, 3:] = covariances[0]
    scene = Scene("a", ViewOptions(record=path))
    shown = [Ellipsoid.of(*one) for one in zip(centres, covariances, strict=True)]
    scene.log_ellipsoids("world/uncertainty", shown)
    information = np.linalg.inv(whole)
    scene.log_frame(FrameResult(0, 0.0, TrackingStatus.OK, np.eye(4), information=information))
    scene.close()
    for entity, where, expected in (
        ("/world/uncertainty", centres, covariances),
        ("/world/camera/uncertainty", np.zeros((1, 3)), covariances[:1]),
    ):
        found, R, half_sizes = shapes(path, entity, "Ellipsoids3D")
        np.testing.assert_allclose(found, where, atol=1e-6)
        squares = R @ (half_sizes[:, :, None] ** 2 * R.mT)
        np.testing.assert_allclose(squares / (3 * ENLARGED) ** 2, expected, atol=1e-9)
