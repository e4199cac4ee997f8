"""The dense map's process, called directly: accuracy of surfaces, masks early or late."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from synthetic_view import HALF_CAMERA as CAMERA
from synthetic_view import PLANE_Z_M, render_half

from bmask_slam.config.configuration import dump
from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.live.processes.dense_messages import (
    DenseSetup,
    KeyframeToMap,
    LateMasks,
    Mapped,
    NotMapped,
    RemoveKeyframes,
    RunMoved,
)
from bmask_slam.live.processes.dense_process import DenseServer
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.system_config import SystemConfig

LABELS = ("background", "person", "chair")
POSES = {k: se3_exp(np.array([0, 0.01 * k, 0, 0.03 * k, 0, 0])) for k in range(8)}
FRAMES = {k: render_half(T, k) for k, T in POSES.items()}
PIXELS = np.array([[50.0, 50.0], [55.0, 60.0], [160.0, 120.0], [250.0, 150.0]])


def instance(label: int, rows: slice, columns: slice) -> Instance:
    mask = np.zeros((240, 320), bool)
    mask[rows, columns] = True
    return Instance(mask, mask_box(mask), label, certain(label, len(LABELS)), 1.0, 1.0)


CHAIR = instance(2, slice(40, 90), slice(40, 100))
PERSON = instance(1, slice(125, 200), slice(200, 280))


def snapshot(number: int, T: Array | None = None) -> KeyframeSnapshot:
    """Keyframes that all observe landmarks with the same four ids."""
    T = POSES[number] if T is None else T
    ids, points = np.arange(4), np.tile([0.0, 0.0, PLANE_Z_M], (4, 1))
    return KeyframeSnapshot(number, 0, T, FRAMES[number], ids, points, PIXELS)


def make_server(path: Path) -> tuple[DenseServer, list[Any]]:
    path.mkdir()
    (path / "config.yaml").write_text(dump(SystemConfig()))
    answers: list[Any] = []
    masks = SegmenterOptions("truth")
    return DenseServer(DenseSetup(path, CAMERA, masks, LABELS, shown=500), answers.append), answers


def to_map(number: int, instances: list[Instance], T: Array | None = None) -> KeyframeToMap:
    whole = snapshot(number, T)
    return KeyframeToMap(whole, instances, {number: whole.T_world_camera})


def mapped(answers: list[Any]) -> list[int]:
    return [m.keyframe_id for m in answers if isinstance(m, Mapped)]


def test_a_submap_is_sent_after_its_neighbours_and_is_accurate(tmp_path) -> None:
    server, answers = make_server(tmp_path / "run")
    for number in POSES:
        server.handle(to_map(number, []))
    assert mapped(answers) == [0, 1]
    depth_m = DenseFolder.open(tmp_path / "run").fused(1).depth_m()
    v, u = np.nonzero(np.isfinite(depth_m))
    points = CAMERA.backproject(np.stack([u, v], axis=1).astype(float), depth_m[v, u])
    assert np.abs((points @ POSES[1][:3, :3].T + POSES[1][:3, 3])[:, 2] - PLANE_Z_M).max() < 0.003
    preview = next(m.preview for m in answers if isinstance(m, Mapped) and m.keyframe_id == 1)
    assert 300 < len(preview.points) <= 500
    shown = preview.points @ POSES[1][:3, :3].T + POSES[1][:3, 3]
    assert np.abs(shown[:, 2] - PLANE_Z_M).max() < 0.003


def test_poses_that_move_before_fusion_are_followed(tmp_path) -> None:
    """Keyframe 0 is 0.3 m off at first; without correction its depth would not be confirmed."""
    server, _ = make_server(tmp_path / "run")
    off = POSES[0].copy()
    off[2, 3] += 0.3
    server.handle(to_map(0, [], off))
    for number in range(1, 7):
        message = to_map(number, [])
        server.handle(KeyframeToMap(message.snapshot, [], {k: POSES[k] for k in range(number + 1)}))
    folder = DenseFolder.open(tmp_path / "run")
    sigma = float(np.nanmedian(folder.fused(0).depth_sigma_m()))
    alone, _ = make_server(tmp_path / "alone")
    alone.handle(to_map(0, []))
    alone._report(alone._fusion.finish())
    single = DenseFolder.open(tmp_path / "alone").fused(0)
    assert sigma < 0.8 * float(np.nanmedian(single.depth_sigma_m()))


@pytest.fixture(scope="module")
def in_time(tmp_path_factory: pytest.TempPathFactory) -> DenseFolder:
    """The dense map of seven keyframes of which the first has masks."""
    path = tmp_path_factory.mktemp("dense") / "run"
    server, _ = make_server(path)
    for number in range(7):
        server.handle(to_map(number, [CHAIR, PERSON] if number == 0 else []))
    return DenseFolder.open(path)


def with_late_masks(path: Path, last: int) -> DenseFolder:
    """The same, but the masks come after keyframe ``last``."""
    server, answers = make_server(path)
    for number in range(7):
        server.handle(to_map(number, []))
        if number == last:
            server.handle(LateMasks(0, [CHAIR, PERSON], np.arange(4), PIXELS))
    assert mapped(answers) == [0]
    return DenseFolder.open(path)


def same_evidence(one: DenseFolder, other: DenseFolder) -> bool:
    pairs = zip(vars(one.evidence(0)).values(), vars(other.evidence(0)).values(), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def test_masks_before_fusion_equal_masks_in_time(tmp_path, in_time) -> None:
    late = with_late_masks(tmp_path / "run", 3)
    for name in ("rho", "variance"):
        a, b = getattr(late.fused(0), name), getattr(in_time.fused(0), name)
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(late.colours(0), in_time.colours(0))
    assert same_evidence(late, in_time)
    assert in_time.evidence(0).landmark_instances.tolist() == [1, 1, 2]


def test_a_weak_detection_excludes_no_pixels(tmp_path) -> None:
    server, _ = make_server(tmp_path / "run")
    for number in range(7):
        server.handle(to_map(number, [CHAIR, replace(PERSON, class_score=0.2)]))
    folder = DenseFolder.open(tmp_path / "run")
    assert np.isfinite(folder.fused(0).depth_m()[PERSON.mask]).mean() > 0.9
    assert set(np.unique(folder.evidence(0).pixels).tolist()) == {0, 1}


def test_late_masks_relabel_a_saved_keyframe(tmp_path, in_time) -> None:
    late = with_late_masks(tmp_path / "run", 6)
    for folder in (late, in_time):
        np.testing.assert_array_equal(folder.evidence(0).pixels == 1, CHAIR.mask)
    assert not np.isfinite(late.fused(0).depth_m()[PERSON.mask]).any()
    assert same_evidence(late, in_time)


def test_a_removed_keyframe_is_removed_before_and_after_saving(tmp_path) -> None:
    server, answers = make_server(tmp_path / "run")
    for number in range(7):
        server.handle(to_map(number, []))
    assert mapped(answers) == [0]
    server.handle(RemoveKeyframes([0, 3]))
    server._report(server._fusion.finish())
    assert mapped(answers) == [0, 1, 2, 4, 5, 6]
    folder = DenseFolder.open(tmp_path / "run")
    assert [k for k in POSES if folder.is_done(k)] == [1, 2, 4, 5, 6]
    assert not list(folder.path.glob("*/000000"))


def test_a_run_folder_that_moves_is_followed(tmp_path) -> None:
    server, answers = make_server(tmp_path / "run")
    for number in range(7):
        server.handle(to_map(number, []))
    assert mapped(answers) == [0]
    (tmp_path / "run").rename(tmp_path / "moved")
    server._report(server._fusion.finish()[:2])  # written nowhere
    assert [m.keyframe_id for m in answers if isinstance(m, NotMapped)] == [1, 2]
    server.handle(RunMoved(tmp_path / "moved"))
    server.handle(to_map(7, []))
    server._report(server._fusion.finish())
    assert mapped(answers) == [0, 7]
    folder = DenseFolder.open(tmp_path / "moved")
    assert [k for k in POSES if folder.is_done(k)] == [0, 7]
    assert not (tmp_path / "run").exists()


def test_a_keyframe_that_cannot_be_mapped_is_reported(tmp_path) -> None:
    server, answers = make_server(tmp_path / "run")
    server.handle(to_map(0, [], np.full((4, 4), np.nan)))
    assert isinstance(answers[0], NotMapped)
    assert "not finite" in answers[0].reason


def test_a_finished_keyframe_is_reported_again_on_request(tmp_path) -> None:
    server, _ = make_server(tmp_path / "run")
    for number in range(7):
        server.handle(to_map(number, []))
    answers: list[Any] = []
    again = DenseServer(server._setup, answers.append)
    again.handle(to_map(0, []))
    assert mapped(answers) == [0]
