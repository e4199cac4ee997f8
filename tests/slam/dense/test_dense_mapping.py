"""``bmask-slam map`` on a small rendered room with true keyframe poses."""

from __future__ import annotations

import errno
import json
import logging
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from drive_map_files import load_nav2
from ruamel.yaml import YAML
from scipy.spatial import cKDTree
from true_run import FRAMES, make_run

from bmask_slam.cli import main
from bmask_slam.dense.folder import LABEL_FILE, DenseFolder
from bmask_slam.dense.keyframe_input import load_keyframe
from bmask_slam.dense.map_run import map_run, remove_stored_frames
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.products import KeyframeEvidence
from bmask_slam.dense.saved_map import MappedRun, open_run
from bmask_slam.dense.surface import FusedMap, make_surface
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.array_file import nested, read_arrays, write_arrays
from bmask_slam.graph.files.file_lock import lock_file
from bmask_slam.graph.files.ply import read_ply, write_ply
from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.graph.trajectory import Trajectory, write_tum
from bmask_slam.mapping.products.cloud import Cloud
from bmask_slam.mapping.products.occupancy import OCCUPIED
from bmask_slam.mapping.products.submaps import read_submap, write_submap
from bmask_slam.rendering.config import RenderConfig
from bmask_slam.run_folder.map_file import read_map, write_map
from bmask_slam.run_folder.reader import Run
from bmask_slam.semantics.beliefs.label_store import LabelStore
from bmask_slam.semantics.segmenters.segmenter import CocoSegmenter
from bmask_slam.sequences.sequence import open_sequence


def shares_of(run: Path) -> dict[str, float]:
    """Share of the map's points by class."""
    shares = json.loads((run / "dense" / "dense.json").read_text())["label_shares"]
    return {str(k): float(v) for k, v in shares.items()}


def truth_file(run: MappedRun) -> Path:
    """The annotations of a rendered sequence."""
    return run.sequence.folder / "annotations.json"


@pytest.fixture(scope="module")
def room(rendered) -> Path:
    return rendered(RenderConfig("office", frames=40, width=160, height=120, true_depth=True))


@pytest.fixture(scope="module")
def mapped(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("runs") / "office", open_sequence(room))
    arguments = ["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--plan", "--mesh"]
    arguments += ["--pcd"]
    assert main([*arguments, "--quiet"]) == 0
    return run


def test_the_products_are_written(mapped: Path) -> None:
    names = {p.name for p in (mapped / "dense").iterdir()}
    expected = {
        "cloud.ply",
        "cloud.pcd",
        "semantic.ply",
        "semantic.pcd",
        "mesh.ply",
        "mesh.glb",
        "plan.png",
        "legend.json",
    }
    assert expected | {"dense.json", "view_first.png", "view_overview_semantic.png"} <= names
    assert not [n for n in names if n.startswith(".")]
    for name in ("plan.png", "view_first.png"):
        image = cv2.imread(str(mapped / "dense" / name))
        assert (image < 250).any(axis=2).mean() > 0.05


def test_fused_depth_is_more_accurate_than_the_sensors(mapped: Path, room: Path) -> None:
    run = open_run(mapped)
    folder = DenseFolder.open(mapped)
    before, after, chi2 = [], [], []
    for keyframe in run.keyframes:
        file = room / "depth_true" / run.sequence.pairs.depth_files[keyframe.frame_index].name
        true_m = cv2.imread(str(file), cv2.IMREAD_UNCHANGED) / run.camera.depth_scale
        sensor_m = load_keyframe(run, keyframe)[0].depth_m
        fused = folder.fused(keyframe.id)
        both = (true_m > 0) & np.isfinite(sensor_m) & np.isfinite(fused.depth_m())
        before.append((sensor_m - true_m)[both])
        after.append((fused.depth_m() - true_m)[both])
        chi2.append(((after[-1] / fused.depth_sigma_m()[both]) ** 2)[np.abs(after[-1]) < 0.05])
    rmse = [np.sqrt(np.mean(np.concatenate(e) ** 2)) for e in (before, after)]
    assert rmse[1] < 0.7 * rmse[0]
    assert 0.4 < np.concatenate(chi2).mean() < 2.5  # coarse steps of depth are shared


def test_labels_agree_with_the_truth(mapped: Path, room: Path) -> None:
    run = open_run(mapped)
    cloud = read_ply(mapped / "dense" / "cloud.ply")
    points = np.stack([cloud[c] for c in "xyz"], axis=1).astype(float)
    keyframe = run.keyframes[4]
    points_camera = transform(inverse(keyframe.T_world_camera), points)
    pixels = np.rint(run.camera.project(points_camera)).astype(int)
    true_m = cv2.imread(str(room / "depth_true" / f"{keyframe.timestamp_s:.6f}.png"), -1) / 5000
    inside = ((pixels >= 0) & (pixels < (160, 120))).all(axis=1) & (points_camera[:, 2] > 0)
    pixels, z, label = pixels[inside], points_camera[inside, 2], cloud["label"][inside]
    visible = np.abs(true_m[pixels[:, 1], pixels[:, 0]] - z) < 0.05
    content = json.loads((room / "annotations.json").read_text())
    found = CocoSegmenter(room / "annotations.json").segment(
        np.zeros((120, 160, 3), np.uint8), f"rgb/{keyframe.timestamp_s:.6f}.png"
    )
    truth = np.zeros((120, 160), int)
    for instance in found:
        truth[instance.mask] = instance.label
    same = truth[pixels[:, 1], pixels[:, 0]] == label
    assert content["categories"]
    assert visible.sum() > 1000
    assert same[visible].mean() > 0.93


def test_a_second_call_fuses_nothing_and_writes_the_same_bytes(
    mapped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = (mapped / "dense" / "cloud.ply").read_bytes()
    arguments = ["map", str(mapped), "--voxel", "0.03", "--segmenter", "truth", "--quiet"]
    stamps = [p.stat().st_mtime_ns for p in sorted((mapped / "dense" / "labels").iterdir())]
    assert main(arguments) == 0
    assert [p.stat().st_mtime_ns for p in sorted((mapped / "dense" / "labels").iterdir())] == stamps
    assert (mapped / "dense" / "cloud.ply").read_bytes() == before


def test_a_stopped_map_is_completed_with_the_same_bytes(mapped: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    for name in ("000003", "000004", "000009"):
        (run / "dense" / "labels" / name).unlink()
    arguments = ["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--quiet", "--mesh"]
    assert main(arguments) == 0
    for name in ("labels/000003", "depth/000009", "mesh.ply", "cloud.ply"):
        assert (run / "dense" / name).read_bytes() == (mapped / "dense" / name).read_bytes()


def test_a_label_that_changes_in_the_store_changes_in_the_map(mapped: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    stamps = [p.stat().st_mtime_ns for p in sorted((run / "dense" / "labels").iterdir())]
    opened, names = open_run(run), CocoSegmenter(truth_file(open_run(run))).labels
    folder = DenseFolder.open(run)
    evidence = [folder.evidence(k.id) for k in opened.keyframes]
    points_camera = [e.log_likelihoods[e.landmark_instances].argmax(axis=1) for e in evidence]
    old = int(np.bincount(np.concatenate(points_camera)).argmax())
    new = names.number("cup")
    assert old not in (0, new)
    store, ids = LabelStore(len(names)), np.flatnonzero(opened.world.landmarks.in_map)
    table = np.zeros((len(ids), len(names)), np.float32)
    table[:, new] = 1.0
    store.update(ids, table, np.full(len(ids), 0.9, np.float32))
    state, camera = read_map(run)
    known = {"names": np.array(names.names), **nested(labels=store.state())}
    write_map(run / "map", state | nested(semantics=known), camera)
    shares = [shares_of(run)]
    assert main(["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--quiet"]) == 0
    shares.append(shares_of(run))
    assert shares[1].get(names.names[old], 0) < 0.3 * shares[0][names.names[old]]
    assert shares[1]["cup"] > shares[0].get("cup", 0) + 0.5 * shares[0][names.names[old]]
    assert [p.stat().st_mtime_ns for p in sorted((run / "dense" / "labels").iterdir())] == stamps


def test_what_a_later_map_does_not_make_is_not_left_of_an_older_surface(
    mapped: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    (run / "dense" / "moving.pcd").write_text("of an older map")
    (run / "dense" / "mesh.blend").write_text("the user's own")
    (run / "dense" / "frames").mkdir()  # of a live run that was killed
    (run / "dense" / "frames" / "00000001").write_bytes(bytes(9))
    arguments = ["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--quiet"]
    assert main(arguments) == 0
    names = {path.name for path in (run / "dense").iterdir()}
    assert not names & {"cloud.pcd", "semantic.pcd", "moving.pcd", "frames"}
    of_surface = {"mesh.ply", "mesh.glb", "view_mesh.png", "plan.png"}
    assert names >= of_surface | {"cloud.ply", "semantic.ply", "mesh.blend"}
    assert main([*arguments, "--mesh-voxel", "0.05"]) == 0
    names = {path.name for path in (run / "dense").iterdir()}
    assert not names & of_surface
    assert names >= {"cloud.ply", "semantic.ply", "view_first_semantic.png", "mesh.blend"}


def test_frames_of_a_run_that_is_being_written_stay(tmp_path: Path) -> None:
    run = tmp_path / "run"
    stored = run / "dense" / "frames"
    stored.mkdir(parents=True)
    (run / "frames.csv").touch()
    with (run / "frames.csv").open("rb") as file:
        lock_file(file, run)
        remove_stored_frames(run, run / "dense")
        assert stored.is_dir()
    remove_stored_frames(run, run / "dense")
    assert not stored.exists()


def test_excluded_classes_are_missing_or_in_another_cloud(mapped: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    names = CocoSegmenter(truth_file(open_run(run))).labels
    arguments = ["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--without", "chair"]
    assert main([*arguments, "--moving", "--quiet"]) == 0
    chair = names.number("chair")
    still, moving = (read_ply(run / "dense" / f"{n}.ply") for n in ("cloud", "moving"))
    assert (still["label"] == chair).mean() < 0.001
    assert (moving["label"] == chair).mean() > 0.9
    assert len(moving["x"]) > 100


@pytest.mark.parametrize("device", ["gpu", "cuda:99", "meta"])
def test_a_device_that_is_not_here_is_refused(mapped: Path, tmp_path: Path, device: str) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run, ignore=shutil.ignore_patterns("dense"))
    with pytest.raises(InputError, match=f"--device {device}: not here .* there are: cpu"):
        map_run(MapOptions(run, device=device))
    assert not (run / "dense").exists()


def test_a_map_of_excluded_classes_alone_is_refused(
    mapped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import bmask_slam.dense.products as module

    opened = open_run(mapped)
    labels = CocoSegmenter(truth_file(opened)).labels
    options = MapOptions(mapped, voxel_m=0.05, excluded=("chair",))
    fused = FusedMap(opened, labels, DenseFolder.open(mapped), options)
    labelled = module._labelled

    def chairs(*given: Any) -> Cloud:
        cloud = labelled(*given)
        return replace(cloud, labels=np.full_like(cloud.labels, labels.number("chair")))

    monkeypatch.setattr(module, "_labelled", chairs)
    with pytest.raises(InputError, match="no surface: all of it is of excluded classes"):
        module.write_products(fused)


def test_keyframes_that_cannot_be_used_are_skipped(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = {1: "no landmarks", 2: "nan pose", 5: "other image"}
    run = make_run(tmp_path / "run", open_sequence(room), broken, FRAMES[:6])
    assert main(["map", str(run), "--voxel", "0.05"]) == 0
    out, err = capsys.readouterr()
    assert "3 fused" in out and "3 left out" in out
    for text in ("keyframe 1: it observes no landmark", "keyframe 2: its pose", "keyframe 5"):
        assert text in err


def test_keyframes_of_a_recording_that_was_continued_are_left_out(
    mapped: Path, tmp_path: Path, caplog
) -> None:
    """Their stamps may be those of other images of this recording."""
    run = shutil.copytree(mapped, tmp_path / "run")
    state, camera = read_map(run)
    ids = np.sort(state["mapper.world.keyframes.id"])
    write_map(run / "map", {**state, "first_keyframe": np.array(ids[2])}, camera)
    assert [k.id for k in open_run(run).keyframes] == ids[2:].tolist()
    assert "2 keyframes are of recordings that it continued, and left out" in caplog.text
    write_map(run / "map", {**state, "first_keyframe": np.array(ids[-1] + 1)}, camera)
    with pytest.raises(InputError, match=r"run: all .* recordings that it continued; give"):
        open_run(run)


def test_a_keyframe_without_depth_is_refused(room: Path, tmp_path: Path) -> None:
    sequence = open_sequence(room)
    run = make_run(tmp_path / "run", sequence)
    moved = tmp_path / "office"
    shutil.copytree(room, moved)
    blank = np.zeros((120, 160), np.uint16)
    cv2.imwrite(str(moved / "depth" / sequence.pairs.depth_files[FRAMES[3]].name), blank)
    with pytest.raises(InputError, match="no valid depth"):
        opened = open_run(run, moved)
        load_keyframe(opened, opened.keyframes[3])


def test_a_full_disk_keeps_the_keyframes_written_before(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", open_sequence(room), frames=FRAMES[:4])
    import bmask_slam.dense.folder as module

    write, count = module.write_depth_map, 0

    def full(path: Path, fused: object) -> None:
        nonlocal count
        count += 1
        if count == 3:
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, fused)  # type: ignore[arg-type]

    monkeypatch.setattr(module, "write_depth_map", full)
    assert main(["map", str(run), "--voxel", "0.05", "--quiet"]) == 1
    assert "No space left" in capsys.readouterr().err
    assert len(list((run / "dense" / "labels").iterdir())) == 2
    monkeypatch.undo()
    assert main(["map", str(run), "--voxel", "0.05", "--quiet"]) == 0


def test_the_surface_follows_poses_that_moved(mapped: Path, tmp_path: Path) -> None:
    """As after a loop that corrects 10 cm, with all tracked frames: nothing stays where it was."""
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    sequence = open_run(run).sequence
    truth = sequence.groundtruth
    assert truth is not None
    poses = inverse(truth.poses_world_camera[0]) @ truth.poses_world_camera
    move = se3_exp(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.0]))
    clouds = []
    for T in (np.eye(4), move):
        state, camera = read_map(run)
        keyframes = state["mapper.world.keyframes.T_world_camera"]
        state["mapper.world.keyframes.T_world_camera"] = T @ keyframes
        write_map(run / "map", state, camera)
        write_tum(run / "trajectory.txt", Trajectory(truth.timestamps_s[::6], T @ poses[::6]))
        arguments = ["map", str(run), "--voxel", "0.03", "--segmenter", "truth", "--quiet"]
        assert main(arguments) == 0
        cloud = read_ply(run / "dense" / "cloud.ply")
        clouds.append(np.stack([cloud[c] for c in "xyz"], axis=1).astype(float))
    apart = cKDTree(transform(move, clouds[0])).query(clouds[1])[0]
    assert np.quantile(apart, 0.95) < 0.02
    stayed = cKDTree(clouds[0]).query(clouds[1][clouds[1][:, 2] < 4])[0]
    assert np.mean(stayed > 0.03) > 0.3


def test_a_kept_volume_reads_only_what_moved(
    mapped: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The last frames are 10 cm off until a loop is closed."""
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    opened = open_run(run)
    assert opened.sequence.groundtruth is not None
    truth = opened.sequence.groundtruth.poses_world_camera
    true = inverse(truth[0]) @ truth
    drifted = true.copy()
    drifted[-8:, :3, 3] += (0.0, 0.0, 0.1)
    stamps_s = opened.sequence.timestamps_s[::4]
    labels = CocoSegmenter(truth_file(opened)).labels

    def surface_with(poses: Array, keep: bool) -> tuple[Array, list[str]]:
        write_tum(run / "trajectory.txt", Trajectory(stamps_s, poses[::4]))
        options = MapOptions(run, voxel_m=0.05, keep_volume=keep)
        caplog.clear()
        with caplog.at_level(logging.INFO):
            fused, seen = FusedMap(opened, labels, DenseFolder.open(run), options), []
            found = make_surface(fused, lambda done, total: seen.append(total - done))
        assert seen[-1] == 0
        return found.vertices.astype(float), [m for m in caplog.messages if "again" in m]

    off, messages = surface_with(drifted, True)
    assert not messages
    same, messages = surface_with(drifted, True)
    assert not messages
    np.testing.assert_array_equal(same, off)
    corrected, messages = surface_with(true, True)
    assert len(messages) == 1
    expected, _ = surface_with(true, False)
    assert np.quantile(cKDTree(expected).query(corrected)[0], 0.99) < 0.002
    assert np.quantile(cKDTree(expected).query(off)[0], 0.95) > 0.01


def test_a_volume_that_is_no_folder_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import bmask_slam.dense.surface as module

    path = tmp_path / "volume"
    path.write_text("no folder")
    assert module.read_or_clear(path, {}) is None
    assert path.is_dir()

    def refuse(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(module, "remove", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        module.read_or_clear(path, {})


def test_a_run_can_make_its_dense_map(
    room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    often = "keyframes={max_shared: 1.1, min_interval_frames: 2, min_tracked: 5}"
    coarse = ["--mesh-voxel", "0.08"]
    arguments = ["run", str(room), "--max-frames", "18", "--map", "--segmenter", "truth", *coarse]
    assert main([*arguments, "--set", often, "--out", str(run), "--quiet"]) == 0
    counts = json.loads((run / "dense" / "dense.json").read_text())
    total = counts["keyframes_fused"]
    assert total == len(open_run(run).keyframes) >= 8
    assert counts["keyframes_reused"] == 0
    assert len(counts["label_shares"]) > 3
    coarse_points = counts["points"]
    capsys.readouterr()
    assert main(["map", str(run), "--mesh-voxel", "0.04"]) == 0
    assert f"0 fused, {total} were finished" in capsys.readouterr().out
    assert json.loads((run / "dense" / "dense.json").read_text())["points"] > 3 * coarse_points


def test_the_dense_map_of_an_overwritten_run_is_not_used(
    room: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    run = make_run(tmp_path / "run", open_sequence(room), frames=FRAMES[:4])
    for began, done in (("2026-01-01 a\nb\n", 0), ("2026-01-01 a\nc\n", 4), ("later\n", 0)):
        (run / "log.txt").write_text(began)
        assert main(["map", str(run), "--voxel", "0.05", "--quiet"]) == 0
        counts = json.loads((run / "dense" / "dense.json").read_text())
        assert counts["keyframes_reused"] == done


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--voxel", "0"], "voxel"),
        (["--without", "elephant", "--segmenter", "truth"], "elephant"),
        (["--masks", "nowhere.json"], "nowhere.json"),
        (["--sequence", "nowhere"], "nowhere"),
    ],
)
def test_bad_options_are_one_line(
    mapped: Path, arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["map", str(mapped), *arguments, "--quiet"]) == 1
    err = capsys.readouterr().err
    assert text in err and err.startswith("error: ")


def test_a_folder_without_a_map_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.ERROR)
    assert main(["map", str(tmp_path)]) == 1
    assert "no saved map" in capsys.readouterr().err


@pytest.mark.parametrize(("rows", "names"), [(2, ["wall"]), (0, ["wall"]), (2, [])])
def test_regions_without_names_for_their_classes_are_refused(
    tmp_path: Path, rows: int, names: list[str]
) -> None:
    folder = DenseFolder(tmp_path, {})
    arrays = {
        "log_likelihoods": np.zeros((1, 3), np.float32),
        "landmark_ids": np.zeros(0, np.int64),
        "landmark_instances": np.zeros(0, np.uint16),
        "stuff": np.zeros((rows, 2 if names else 0), np.float32),
    }
    write_arrays(folder.path / "labels" / "000007", LABEL_FILE, {"stuff": names}, arrays)
    with pytest.raises(InputError, match=r"labels/000007: regions of . classes, but . names"):
        folder.evidence(7)


def test_a_pixel_of_an_instance_that_is_not_there_is_refused(tmp_path: Path) -> None:
    folder = DenseFolder(tmp_path, {})
    arrays = {
        "log_likelihoods": np.zeros((2, 3), np.float32),
        "landmark_ids": np.zeros(0, np.int64),
        "landmark_instances": np.zeros(0, np.uint16),
        "pixels": np.full((4, 5), 2, np.uint16),
    }
    write_arrays(folder.path / "labels" / "000007", LABEL_FILE, {}, arrays)
    with pytest.raises(InputError, match="labels/000007: a pixel of an instance"):
        folder.evidence(7)


def test_keyframes_of_another_dense_map_are_taken_over(mapped: Path, tmp_path: Path) -> None:
    part = DenseFolder.reading(mapped)
    folder = DenseFolder(tmp_path, part.settings | {"run": "another"})
    assert folder.is_like(part)
    (tmp_path / "b").mkdir()
    assert not DenseFolder(tmp_path / "b", part.settings | {"voxel_m": 0.5}).is_like(part)
    assert folder.take_over(part, {0: 20, 1: 21, 99: 119}, lambda ids: ids + 1000) == 2
    assert [folder.is_done(k) for k in (20, 21, 119, 0)] == [True, True, False, False]
    before, after = part.evidence(1), folder.evidence(21)
    assert len(before.landmark_ids) > 0
    assert (after.landmark_ids == before.landmark_ids + 1000).all()
    assert (after.log_likelihoods == before.log_likelihoods).all()
    np.testing.assert_array_equal(folder.fused(21).rho, part.fused(1).rho)  # NaN where missing
    assert (folder.colours(20) == part.colours(0)).all()


@pytest.mark.parametrize("kind", ["colours/000001.jpg", "depth/000001"])
def test_a_link_to_another_file_in_a_dense_map_is_not_copied(
    mapped: Path, tmp_path: Path, kind: str
) -> None:
    """As in a run that a stranger sent, to be merged: what it leads to would be in the result."""
    shutil.copytree(mapped / "dense", tmp_path / "given" / "dense")
    (tmp_path / "private").write_text("secret")
    (tmp_path / "given" / "dense" / kind).unlink()
    (tmp_path / "given" / "dense" / kind).symlink_to(tmp_path / "private")
    (tmp_path / "merged").mkdir()
    part = DenseFolder.reading(tmp_path / "given")
    folder = DenseFolder(tmp_path / "merged", part.settings | {"run": "another"})
    with pytest.raises(InputError, match=f"{kind}: not a"):
        folder.take_over(part, {1: 21}, lambda ids: ids)
    held = [path.read_bytes() for path in folder.path.rglob("*") if path.is_file()]
    assert not [data for data in held if b"secret" in data]


def test_files_with_other_names_among_the_keyframes_are_no_keyframes(mapped: Path) -> None:
    folder = DenseFolder.reading(mapped)
    before = folder.finished()
    for name in ("000003 copy 2", "1_000", "000003-1"):
        (mapped / "dense" / "labels" / name).write_text("")
    assert folder.finished() == before
    for name in ("000003 copy 2", "1_000", "000003-1"):
        (mapped / "dense" / "labels" / name).unlink()


@pytest.mark.parametrize("wrong", ["classes", "instance", "landmark", "no classes"])
def test_evidence_of_other_classes_landmarks_or_instances_is_refused(
    mapped: Path, tmp_path: Path, wrong: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    names = CocoSegmenter(truth_file(open_run(run))).labels
    store, ids = LabelStore(len(names)), np.flatnonzero(open_run(run).world.landmarks.in_map)
    table = np.full((len(ids), len(names)), 1 / len(names), np.float32)
    store.update(ids, table, np.full(len(ids), 0.9, np.float32))
    state, camera = read_map(run)
    known = {"names": np.array(names.names), **nested(labels=store.state())}
    write_map(run / "map", state | nested(semantics=known), camera)
    fused = FusedMap(open_run(run), names, DenseFolder.open(run), MapOptions(run))
    KeyframeEvidence(fused).table(None)
    path = run / "dense" / "labels" / "000001"
    header, arrays = read_arrays(path, LABEL_FILE)
    one = arrays["log_likelihoods"]
    change = {
        "classes": {"log_likelihoods": one[:, :-1]},
        "instance": {"landmark_instances": np.full_like(arrays["landmark_instances"], 60000)},
        "landmark": {"landmark_ids": np.full_like(arrays["landmark_ids"], 10**9)},
        "no classes": {"log_likelihoods": one[:, :0]},
    }
    write_arrays(path, LABEL_FILE, {"stuff": header["stuff"]}, arrays | change[wrong])
    with pytest.raises(InputError, match="labels/000001: its arrays do not fit together"):
        KeyframeEvidence(fused).table(None)


WITHOUT_CHAIR = ["--voxel", "0.03", "--segmenter", "truth", "--without", "chair", "--moving"]


@pytest.fixture(scope="module")
def without_chair(mapped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("left_out") / "run"
    shutil.copytree(mapped, run)
    assert main(["map", str(run), *WITHOUT_CHAIR, "--quiet"]) == 0
    return run


def test_excluded_points_of_an_instance_that_is_not_there_are_refused(
    without_chair: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(without_chair, run)
    path = next(p for p in sorted((run / "dense" / "moving").iterdir()) if len(read_submap(p)))
    submap = read_submap(path)
    write_submap(path, replace(submap, instances=np.full_like(submap.instances, 60000)))
    assert main(["map", str(run), *WITHOUT_CHAIR]) == 1
    assert f"moving/{path.name}: its arrays do not fit together" in capsys.readouterr().err


def test_a_map_to_drive_on_that_is_too_large_by_a_few_points_is_refused(
    mapped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    shutil.copytree(mapped, run)
    arguments = ["export", str(run), "--format", "nav2", "--out", str(tmp_path / "map.yaml")]
    assert main(arguments) == 0
    cloud = read_ply(run / "dense" / "cloud.ply")
    for rows, place in ((slice(-3, None), (1000.0, 0, 0)), (slice(-6, -3), (0, 0, 1000.0))):
        for axis, value in zip("xyz", place, strict=True):
            cloud[axis][rows] = value
    write_ply(run / "dense" / "cloud.ply", cloud)
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert "m large; choose a larger --resolution" in said
    assert f"error: {run / 'dense' / 'cloud.ply'}: " in said
    cloud["x"][-3:] = 1e4
    write_ply(run / "dense" / "cloud.ply", cloud)
    assert main(arguments) == 1
    said = capsys.readouterr().err
    assert f"error: {run / 'dense' / 'cloud.ply'}: no surface may be beyond 1638.4 m" in said


def occupied_share(run: Path, yaml: Path, points_world: Array) -> float:
    """Share of occupied cells among those of points (N, 3) from 0.1 to 1.5 m above the floor."""
    arguments = ["export", str(run), "--format", "nav2", "--out", str(yaml), "--quiet"]
    assert main([*arguments, "--resolution", "0.1"]) == 0  # of points 3 cm apart
    grid = load_nav2(yaml)
    T_map_world = np.array(YAML(typ="safe").load(yaml)["bmask_slam_T_map_world"])
    placed = transform(T_map_world, points_world)
    placed = placed[(placed[:, 2] > 0.15) & (placed[:, 2] < 1.4)]
    columns, rows = np.floor((placed[:, :2] - grid.origin_m) / grid.resolution_m).astype(int).T
    inside = (rows >= 0) & (columns >= 0)
    inside &= (rows < grid.cells.shape[0]) & (columns < grid.cells.shape[1])
    cells = np.unique(np.stack([rows, columns], axis=1)[inside], axis=0)
    return float((grid.cells[tuple(cells.T)] == OCCUPIED).sum() / len(cells))


def test_what_is_left_out_of_the_map_is_no_obstacle(
    mapped: Path, without_chair: Path, tmp_path: Path
) -> None:
    """A chair; the desk stays but near the chair, whose masks are widened by some of the pixels."""
    cloud, shares = Run(mapped).dense_cloud, {}
    for run in (mapped, without_chair):
        for name in ("chair", "desk"):
            points = cloud.points_world[cloud.labels == name]
            shares[run, name] = occupied_share(run, tmp_path / "map.yaml", points)
    assert shares[mapped, "chair"] > 0.7
    assert shares[without_chair, "chair"] < 0.1
    assert shares[mapped, "desk"] > 0.9
    assert shares[without_chair, "desk"] > 0.5
