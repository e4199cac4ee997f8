"""The surface that grows: frames between keyframes, a loop, masks, crashes, a full disk."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import fill
from synthetic_view import HALF_CAMERA as CAMERA
from synthetic_view import PLANE_Z_M, render_half

from bmask_slam.config.configuration import dump
from bmask_slam.dense.growing import frames as frames_module
from bmask_slam.dense.growing.frames import (
    FrameOptions,
    FrameQueue,
    FramesTaken,
    SurfaceFrame,
)
from bmask_slam.dense.growing.store import FrameStore
from bmask_slam.dense.growing.surface import GrowingSurface
from bmask_slam.dense.keyframe_input import KeyframeSnapshot
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.live.processes.dense_messages import (
    DenseSetup,
    KeyframeToMap,
    LateMasks,
    MapPoses,
    RemoveKeyframes,
    RunMoved,
    ShowSurface,
)
from bmask_slam.live.processes.dense_process import DenseServer
from bmask_slam.mapping.surface.extraction import Surface
from bmask_slam.mapping.surface.parts import SurfacePart
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions
from bmask_slam.sequences.frame import Frame
from bmask_slam.system_config import SystemConfig
from bmask_slam.world.frame_history import FrameHistory
from bmask_slam.world.keyframe import Keyframe
from bmask_slam.world.world_map import WorldMap

KEYFRAMES = 4
POSES = {k: se3_exp(np.array([0, 0.01 * k, 0, 0.06 * k, 0, 0])) for k in range(KEYFRAMES)}
FRAMES = {k: render_half(T, 10 * k) for k, T in POSES.items()}
BETWEEN = se3_exp(np.array([0, 0.015, 0, 0.09, 0, 0]))
"""Between keyframes 1 and 2."""
IMAGES = render_half(BETWEEN, 15)
SEEN_BY_ALL = 0.165, 0.0, PLANE_Z_M
"""In the masks of all keyframes."""
IDS, PIXELS = np.arange(4), np.array([[50.0, 50.0], [55.0, 60.0], [160.0, 120.0], [250, 150]])
STEP = GrowingSurface.step
LABELS = ("background", "person")


def between(reference: int = 1) -> SurfaceFrame:
    return SurfaceFrame(IMAGES, 1, reference, inverse(POSES[reference]) @ BETWEEN)


def make_server(path: Path, answers: list[Any] | None = None) -> DenseServer:
    path.mkdir(exist_ok=True)
    (path / "config.yaml").write_text(dump(SystemConfig()))
    send = (answers if answers is not None else []).append
    setup = DenseSetup(path, CAMERA, SegmenterOptions("truth"), LABELS, mesh_voxel_m=0.04)
    return DenseServer(setup, send)


def placed(server: DenseServer, poses: dict[int, Array]) -> None:
    server.handle(MapPoses(np.array(list(poses)), np.array(list(poses.values()))))


def with_keyframes(server: DenseServer, poses: dict[int, Array] | None = None) -> DenseServer:
    """The server with all keyframes fused."""
    points = np.tile([0.0, 0.0, PLANE_Z_M], (4, 1))
    for k, T in (poses or POSES).items():
        snapshot = KeyframeSnapshot(k, 0, T, FRAMES[k], IDS, points, PIXELS)
        server.handle(KeyframeToMap(snapshot, [], {k: T}))
    server._report(server._fusion.finish())
    placed(server, poses or POSES)
    return server


def worked(server: DenseServer) -> Surface:
    """The surface when there is nothing left to do."""
    while server.growing.work():
        pass
    return server.growing._begun().whole()


def off_m(surface: Surface) -> float:
    return float(np.quantile(np.abs(surface.vertices[:, 2] - PLANE_Z_M), 0.9))


@pytest.fixture(scope="module")
def grown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder that a process with fused keyframes and a frame left, as if it was killed."""
    path = tmp_path_factory.mktemp("grown") / "run"
    server = with_keyframes(make_server(path))
    server.handle(between())
    assert worked(server).views.max() == KEYFRAMES + 1
    return path


def test_a_frame_between_keyframes_reaches_the_surface_once_a_newer_one_is_fused(tmp_path) -> None:
    answers: list[Any] = []
    server = make_server(tmp_path / "run", answers)
    server.handle(between())
    server.growing._begun().fused |= {0, 1}
    placed(server, POSES)
    assert server.growing._begun().due() == [-1, -2]
    server.growing._begun().fused.clear()
    surface = worked(with_keyframes(server))
    assert surface.views.max() == KEYFRAMES + 1
    assert off_m(surface) < 0.002
    told = [m for m in answers if isinstance(m, FramesTaken)]
    assert told[0] == FramesTaken(15, 0, 0, 0)
    assert told[-1] == FramesTaken(-1, 0, 1, 0)


def test_a_loop_that_moves_keyframes_ten_centimetres_moves_frames_and_surface(tmp_path) -> None:
    drifted = {k: T.copy() for k, T in POSES.items()}
    for k in (1, 2, 3):
        drifted[k][2, 3] += 0.1
    server = with_keyframes(make_server(tmp_path / "run"), drifted)
    server.handle(between())
    assert off_m(worked(server)) > 0.03
    placed(server, POSES)
    corrected = worked(server)
    assert off_m(corrected) < 0.002
    assert corrected.views.max() == KEYFRAMES + 1
    np.testing.assert_allclose(server.growing._begun()._pose(15), BETWEEN, atol=1e-12)


def test_a_process_in_place_of_a_killed_one_makes_the_same_surface(grown) -> None:
    server = make_server(grown)
    placed(server, POSES)
    again = worked(server)
    assert (again.views.max(), server.growing._begun().integrated) == (KEYFRAMES + 1, 1)
    assert off_m(again) < 0.002


def test_culled_keyframes_and_what_follows_other_segments_leave_the_surface(grown) -> None:
    server = make_server(grown)
    placed(server, {k: POSES[k] for k in (0, 1, 3)})  # 2 is in another segment
    assert worked(server).views.max() == 4
    server.growing.remove([3])
    assert worked(server).views.max() == 3
    placed(server, {0: POSES[0]})
    assert worked(server).views.max() == 1


def test_late_masks_are_cut_out_of_the_surface(tmp_path) -> None:
    server = with_keyframes(make_server(tmp_path / "run"))
    server.handle(between())
    before = worked(server)
    mask = np.zeros((240, 320), bool)
    mask[100:140, 140:190] = True
    person = Instance(mask, mask_box(mask), 1, certain(1, 2), 1.0, 1.0)
    for k in POSES:
        server.handle(LateMasks(k, [person], IDS, PIXELS))
    after = worked(server)
    middle = [np.abs(s.vertices - SEEN_BY_ALL).max(axis=1) < 0.04 for s in (before, after)]
    assert before.views[middle[0]].min() == KEYFRAMES + 1
    assert not middle[1].any()  # what one frame saw and no keyframe may show is not enough


def test_parts_that_change_are_shown_and_those_that_vanish_emptied(grown) -> None:
    answers: list[Any] = []
    server = make_server(grown, answers)
    placed(server, POSES)
    server.handle(ShowSurface())
    worked(server)
    server.growing._show(1000)
    parts = {m.region: m for m in answers if isinstance(m, SurfacePart)}
    assert len(parts) > 1
    points = np.concatenate([p.vertices for p in parts.values()])
    assert np.abs(points[:, 2] - PLANE_Z_M).max() < 0.02
    for p in parts.values():
        assert p.triangles.max() < len(p.vertices) == len(p.colours) == len(p.normals)
        np.testing.assert_allclose(p.normals[:, 2], -1, atol=0.05)
    placed(server, {})
    worked(server)
    server.growing._show(1000)
    parts = {m.region: m for m in answers if isinstance(m, SurfacePart)}
    assert not any(len(p.triangles) for p in parts.values())


def test_a_keyframe_culled_while_a_loop_is_followed_leaves_no_trace(tmp_path) -> None:
    server = with_keyframes(make_server(tmp_path / "run"))
    worked(server)
    drifted = {k: T.copy() for k, T in POSES.items()}
    drifted[0][2, 3] += 0.1
    placed(server, drifted)
    surface = server.growing._begun()
    while surface._following is None:
        server.growing.work()
    server.handle(RemoveKeyframes([3]))
    found = worked(server)
    again = make_server(tmp_path / "run")
    placed(again, drifted)
    np.testing.assert_array_equal(np.sort(found.views), np.sort(worked(again).views))


def test_a_broken_keyframe_does_not_take_the_frames_around_it_along(tmp_path, caplog) -> None:
    server = with_keyframes(make_server(tmp_path / "run"))
    worked(server)
    (tmp_path / "run" / "dense" / "depth" / "000001").write_bytes(b"broken")
    server.handle(between())
    assert worked(server).views.max() == KEYFRAMES + 1
    assert "frames are judged without it" in caplog.text


# --- files ---------------------------------------------------------------------------------------


def test_frames_are_stored_without_loss_of_depth(tmp_path) -> None:
    rng = np.random.default_rng(0)
    raw = rng.integers(0, 65536, (240, 320))
    depth_m = np.where(raw > 0, raw / np.float32(5000), np.float32(np.nan)).astype(np.float32)
    store = FrameStore(tmp_path, CAMERA, 1 << 24)
    store.add(replace(between(), frame=replace(IMAGES, depth_m=depth_m)))
    found = FrameStore(tmp_path, CAMERA, 1 << 24).load(15)
    np.testing.assert_array_equal(found.depth_m, depth_m)
    assert np.abs(found.rgb.astype(int) - IMAGES.rgb).mean() < 2


def test_a_bounded_store_and_a_full_disk_refuse_frames_and_say_so(small_disk, caplog) -> None:
    bounded = FrameStore(small_disk, CAMERA, 1000)
    assert not bounded.add(between())
    assert "its largest size" in caplog.text
    store = FrameStore(small_disk, CAMERA, 1 << 24)
    ballast = fill(small_disk)
    assert not store.add(between())
    assert "No space left" in caplog.text
    assert (store.unwritten, store.places) == (1, {})
    ballast.unlink()
    assert store.add(between())
    assert store.load(15).depth_m.shape == (240, 320)


def refuse_frames(surface: GrowingSurface, ended: bool = False) -> bool:
    """A step of a surface whose volume cannot grow by a frame."""
    if any(number >= 0 for number in surface.due(ended)):
        surface._surface.volume._reserve(1 << 20)
    return STEP(surface, ended)


@pytest.mark.parametrize("small_disk", ["30m"], indirect=True)
def test_after_a_full_disk_the_surface_is_begun_again(small_disk, caplog, monkeypatch) -> None:
    server = with_keyframes(make_server(small_disk / "run"))
    ballast = fill(small_disk)
    assert not server.growing.work()
    assert "the surface is begun again later" in caplog.text
    ballast.unlink()
    server.growing._begin_s = 0.0
    assert worked(server).views.max() == KEYFRAMES
    server.handle(between())
    fill(small_disk)
    monkeypatch.setattr(GrowingSurface, "step", refuse_frames)
    grown = server.growing.finish()
    assert "the surface is made of keyframes alone" in caplog.text
    assert (grown.frames, grown.surface.views.max()) == (0, KEYFRAMES)
    server.growing._end()  # the disk is unmounted


def test_a_surface_that_is_begun_after_the_run_folder_was_renamed_has_its_frames(tmp_path) -> None:
    """As that of the last process, which is made at the end, or that after a full disk."""
    server = with_keyframes(make_server(tmp_path / "run"))
    server.handle(between())
    (tmp_path / "run").rename(tmp_path / "renamed")
    server.handle(RunMoved(tmp_path / "renamed"))
    grown = server.growing.finish()
    assert (grown.frames, grown.surface.views.max()) == (1, KEYFRAMES + 1)


# --- which frames --------------------------------------------------------------------------------


class Sent:
    """A queue, and what it sent."""

    def __init__(self, **options: Any) -> None:
        self.frames: list[SurfaceFrame] = []
        self.queue = FrameQueue(FrameOptions(**options), self.frames.append)

    def offer(self, time_s: float, T: Array, keyframe: int | None = None) -> None:
        frame = Frame(round(30 * time_s), time_s, np.zeros((2, 2, 3), np.uint8), np.ones((2, 2)))
        own = None if keyframe is None else Keyframe.__new__(Keyframe)
        if own is not None:
            own.id = keyframe
        reference = Keyframe.__new__(Keyframe)
        reference.id, reference.T_world_camera = 7, POSES[3]
        self.queue.offer(frame, T, reference, own)


def test_frames_are_chosen_by_time_and_motion() -> None:
    sent = Sent(per_s=5.0, min_shift_m=0.03, min_turn_deg=3.0)
    sent.offer(0.0, POSES[0])  # before the first keyframe
    sent.offer(0.1, POSES[0], keyframe=0)
    for time_s, xi in (
        (0.2, (0, 0, 0, 0.02, 0, 0)),  # the first one
        (0.4, (0, 0, 0, 0.04, 0, 0)),  # too near
        (0.4, (0, 0, 0, 0.051, 0, 0)),
        (0.5, (0, 0, 0, 0.15, 0, 0)),  # too early
        (0.6, (0, 0.04, 0, 0.05, 0, 0)),  # not turned enough
        (0.8, (0, 0.06, 0, 0.05, 0, 0)),
    ):
        sent.offer(time_s, se3_exp(np.array(xi)))
    assert [f.number for f in sent.frames] == [6, 12, 24]
    first = sent.frames[0]
    assert (first.after, first.reference) == (0, 7)
    shifted = se3_exp(np.array([0, 0, 0, 0.02, 0, 0]))
    np.testing.assert_allclose(POSES[3] @ first.T_reference_camera, shifted, atol=1e-12)
    none = Sent(per_s=0.0)
    none.offer(0.0, POSES[0], keyframe=0)
    none.offer(9.0, POSES[3])
    assert not none.frames


def test_frames_are_dropped_while_the_surface_is_behind_and_sent_again_after_a_crash() -> None:
    sent, most = Sent(per_s=1000.0), frames_module.MAX_SENT
    sent.offer(0.0, POSES[0], keyframe=0)
    for k in range(1, most + 3):
        sent.offer(0.1 * k, se3_exp(np.array([0, 0, 0, 0.1 * k, 0, 0])))
    assert (len(sent.frames), sent.queue.dropped, sent.queue.full) == (most, 2, True)
    sent.queue.taken(FramesTaken(sent.frames[0].number, frames_module.MAX_BACKLOG, 0, 0))
    assert sent.queue.full
    sent.queue.taken(FramesTaken(-1, 0, 9, 0))
    assert (sent.queue.full, sent.queue.integrated) == (False, 9)
    sent.queue.send_again()
    assert [f.number for f in sent.frames[most:]] == [f.number for f in sent.frames[1:most]]


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(InputError, match="per_s -1"):
        FrameOptions(-1.0)


def world_in_segments(*segments: int) -> WorldMap:
    """A keyframe in each of these segments, without landmarks."""
    world = WorldMap()
    for k, segment in enumerate(segments):
        keyframe = Keyframe.__new__(Keyframe)
        keyframe.id, keyframe.segment, keyframe.T_world_camera = k, segment, POSES[k]
        world.keyframes[k] = keyframe
    return world


def test_poses_of_culled_keyframes_are_those_that_their_parents_give_them() -> None:
    world, history = world_in_segments(0, 0, 5), FrameHistory()
    T_1_3 = inverse(POSES[1]) @ POSES[3]
    history.hand_over(3, 1, T_1_3)
    history.hand_over(4, 2, T_1_3)
    found = MapPoses.of(world, history, {0, 3, 4}).by_id()
    assert sorted(found) == [0, 1, 3]
    np.testing.assert_allclose(found[3], POSES[3], atol=1e-12)


def test_the_surface_follows_the_segment_of_most_frames() -> None:
    """That which trajectory.txt is of, also where another one has more keyframes."""
    world, history = world_in_segments(5, 0, 0), FrameHistory()
    for k in range(3):
        history.append(0.1 * k, 0, POSES[0], POSES[0])
    assert sorted(MapPoses.of(world, history, set()).by_id()) == [0]


def test_removal_reaches_the_surface(tmp_path) -> None:
    server = with_keyframes(make_server(tmp_path / "run"))
    worked(server)
    server.handle(RemoveKeyframes([3]))
    assert worked(server).views.max() == KEYFRAMES - 1
