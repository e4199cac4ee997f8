"""Messages of tracking to the map's process."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from synthetic_view import CAMERA, render_plane, sideways_path

from bmask_slam.back_end.reinterpretation import KeyframeMotion
from bmask_slam.config.configuration import resolve
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.files.array_file import read_arrays
from bmask_slam.graph.geometry import se3_exp
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.graph.smoother.storage import read_camera
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW, LabelView
from bmask_slam.live.messages import (
    STATE_FILE,
    Handled,
    LostKeyframe,
    MapChanged,
    Masks,
    NewKeyframe,
    PruneMask,
    RestoreObservations,
    SaveState,
    Started,
    StateSaved,
    UseCamera,
    VisibilityCounts,
)
from bmask_slam.live.processes import map_worker
from bmask_slam.live.processes.map_process import MapServer
from bmask_slam.live.processes.map_return import MapPlace
from bmask_slam.live.processes.remote_mapper import MAX_UNSAVED, RemoteMapper
from bmask_slam.semantics.instances.instances import Instance, PackedMask, certain, mask_box
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.segmenter_table import LabelsOnly, SegmenterOptions
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import starting
from bmask_slam.world.frame_history import ENTRY, NO_KEYFRAME, UNKNOWN

NO_IDS = np.zeros(0, np.int64)


def keyframe(
    system: SlamSystem,
    number: int,
    reference: tuple[int, Array] | None,
    visibility: VisibilityCounts | None = None,
) -> NewKeyframe:
    T_world_camera = se3_exp(np.array([0, 0, 0, 0.02 * number, 0, 0]))
    frame = render_plane(T_world_camera, number)
    tracked = starting(T_world_camera, system.prepare(frame))
    first, size = 2000 * number, len(tracked.features)
    has_depth = np.isfinite(tracked.features.depth_m)
    new_ids = np.where(has_depth, first + np.cumsum(has_depth) - 1, -1)
    entries = np.array([(number / 30, number, np.eye(4), UNKNOWN)], ENTRY)
    return NewKeyframe(
        number,
        frame.index,
        frame.timestamp_s,
        replace(tracked, new_ids=new_ids),
        0,
        reference,
        NO_IDS,
        (first, first + size),
        visibility or VisibilityCounts(NO_IDS, NO_IDS, NO_IDS),
        entries,
        frame.depth_m[::2, ::2],
    )


def test_a_segment_restarts_after_losing_its_first_keyframe() -> None:
    answers: list[Any] = []
    system = SlamSystem(CAMERA)
    server = MapServer(system, answers.append)
    nothing = np.zeros(0, ENTRY)
    server.handle(1, LostKeyframe(0, NO_KEYFRAME, np.eye(4), nothing, 500))
    server.handle(2, keyframe(system, 1, (0, np.eye(4))))  # made while the first was being lost
    counts = VisibilityCounts(np.arange(500), np.ones(500, int), np.ones(500, int))
    server.handle(3, keyframe(system, 2, None, counts))
    world = system.mapper.world
    assert list(world.keyframes) == [2]
    assert not world.landmarks.in_map[:500].any()
    assert world.landmarks.in_map.sum() > 100
    deltas = [answer.delta for answer in answers if isinstance(answer, MapChanged)]
    parents = {k: parent for delta in deltas for k, (parent, _) in delta.parents.items()}
    assert parents == {0: NO_KEYFRAME, 1: NO_KEYFRAME}
    trajectory = system.trajectory()
    assert trajectory.timestamps_s.tolist() == [2 / 30]  # those of the lost ones have no pose


def test_masks_of_a_frame_that_is_no_keyframe_label_the_map() -> None:
    answers: list[Any] = []
    names = label_set(("wall",))
    system = SlamSystem(CAMERA, segmenter=LabelsOnly(names.names, SegmenterOptions("none")))
    server = MapServer(system, answers.append)
    made = keyframe(system, 0, None)
    server.handle(1, made)
    seen = made.tracked.features.image_pixels, made.tracked.new_ids
    number, wall = FIRST_LABEL_VIEW + 4, np.ones((CAMERA.height, CAMERA.width), bool)
    server.handle(2, LabelView(number, 0.1, 0, np.eye(4), *seen, made.depth_m))
    mask = Instance(wall, mask_box(wall), 1, certain(1, 2, 0.9), 0.9, 0.9)
    server.handle(3, Masks(number, [mask]))
    world = system.mapper.world
    assert len(system.semantics.labels.known()) == world.landmarks.in_map.sum() > 100
    assert world.label_views == 5
    deltas = [answer.delta for answer in answers if isinstance(answer, MapChanged)]
    server.send_changes(-1, done=False)
    assert answers[-1].delta.label_views == 5 > deltas[-1].label_views


def test_observations_removed_under_a_mask_are_restored() -> None:
    answers: list[Any] = []
    system = SlamSystem(CAMERA)
    server = MapServer(system, answers.append)
    server.handle(1, keyframe(system, 0, None))
    server.handle(2, keyframe(system, 1, (0, np.eye(4))))
    one, landmarks = system.mapper.world.keyframes[1], system.mapper.world.landmarks
    mask = np.zeros((CAMERA.height, CAMERA.width), bool)
    mask[100:300, 200:400] = True
    all_patches, next_id = landmarks.patches_of(one.landmark_ids), len(landmarks)
    server.handle(3, PruneMask(1, PackedMask.of(mask), 0))
    under = np.flatnonzero(one.masked)
    assert len(under) > 20
    reserved = (next_id, next_id + len(under))
    server.handle(4, RestoreObservations(1, under, all_patches[under], reserved))
    assert not one.masked.any()
    back = one.landmark_ids[under]
    with_depth = np.isfinite(one.features.depth_m[under])
    assert (back[with_depth] >= 0).all()
    assert landmarks.in_map[back[back >= 0]].all()
    made = back >= next_id
    assert made.any()
    np.testing.assert_array_equal(landmarks.patches[back[made]], all_patches.images[under[made]])
    assert np.isfinite(landmarks.patch_views[back[made]][:, 0]).all()
    delta = [answer for answer in answers if isinstance(answer, MapChanged)][-1].delta
    assert np.isin(back[back >= 0], delta.ids).all()
    gone = RestoreObservations(7, under, all_patches[under], (len(landmarks), len(landmarks) + 9))
    server.handle(5, gone)  # culled meanwhile
    server.handle(6, keyframe(system, 2, (1, one.T_world_camera)))
    assert list(system.mapper.world.keyframes) == [0, 1, 2]


def test_another_camera_reaches_the_map_its_keyframes_and_the_saved_state(tmp_path) -> None:
    often = ("keyframes.min_interval_frames=2", "keyframes.max_shared=0.9")
    config = resolve(SystemConfig, None, often)
    system = SlamSystem(CAMERA, config)
    for number, pose in enumerate(sideways_path(0.02 * np.arange(16))):
        system.process(render_plane(pose, number))
    server, mapper = MapServer(system, lambda answer: None), system.mapper
    one, two = list(mapper.world.keyframes.values())[:2]
    before, untouched = two.features.pixels, one.features.pixels
    found = replace(CAMERA, rolling_shutter_s=0.02)
    motion = KeyframeMotion(np.array([0, 0, 0, 0.6, 0, 0]))
    server.handle(1, UseCamera(found, {two.id: motion, 99: motion}))  # 99 was culled meanwhile
    np.testing.assert_array_equal(one.features.pixels, untouched)
    shift = two.features.pixels[:, 0] - before[:, 0]  # rows below the mean were exposed later
    assert np.corrcoef(shift, before[:, 1])[0, 1] > 0.9 and np.abs(shift).max() > 1
    graph = mapper.smoother.tables.observations.all()
    rows = np.flatnonzero(graph.keyframe_ids == two.id)
    assert len(rows) and np.isin(graph.measurements[rows, 0], two.features.pixels[:, 0]).all()
    assert system.camera_tracker.tracker.camera == mapper.camera == found
    server.handle(2, SaveState(tmp_path / "state"))
    header, _ = read_arrays(tmp_path / "state", STATE_FILE)
    assert read_camera(header, tmp_path) == found


def test_a_state_that_cannot_be_written_is_done_without(tmp_path, caplog) -> None:
    answers: list[Any] = []
    server = MapServer(SlamSystem(CAMERA, SystemConfig()), answers.append)
    path = tmp_path / "missing/state"
    server.handle(1, SaveState(path))
    assert answers == [Started(1), Handled(1)]
    assert str(path) in caplog.text


class Saving:
    """Stands in for the map's process: saves every state at once."""

    is_running = True

    def __init__(self, *_: object) -> None:
        self._answers: list[Any] = []

    def send(self, numbered: tuple[int, Any]) -> None:
        number, message = numbered
        if isinstance(message, SaveState):
            self._answers.append(StateSaved(number, message.path))

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        found, self._answers = self._answers, []
        return found


def test_measurements_of_a_robot_that_stands_still_do_not_pile_up(tmp_path, monkeypatch) -> None:
    """Without keyframes too; a process that is started again would get all of them."""
    monkeypatch.setattr(map_worker, "Worker", Saving)
    config = resolve(SystemConfig, None, ("sensors.imu.enabled=true",))
    mapper = RemoteMapper(CAMERA, config, ("background",), MapPlace(tmp_path))
    for number in range(2 * MAX_UNSAVED + 10):
        mapper.add_measurements(Measurements("imu", np.full((1, 7), number / 30)))
        mapper.catch_up()
    assert mapper.worker.saves == 2
    assert not mapper.worker.lacks(0, mapper.worker.saved)
    assert mapper.worker.lacks(mapper.worker.saved, mapper.worker.sent)
