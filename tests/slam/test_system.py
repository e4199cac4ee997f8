"""The whole system on a textured plane with exact truth, and on real frames."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from repository import KITCHEN, shared
from synthetic_view import CAMERA, render_or_black, render_plane

from bmask_slam.config.configuration import resolve
from bmask_slam.events import EventKind
from bmask_slam.features.brisk import FeatureConfig
from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log
from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set
from bmask_slam.semantics.segmenters.segmenter import NoSegmenter
from bmask_slam.sequences.frame import Frame
from bmask_slam.sequences.sequence import open_sequence
from bmask_slam.system import SlamSystem
from bmask_slam.system_config import SystemConfig
from bmask_slam.tracking.results import FrameResult, TrackingStatus


@pytest.mark.parametrize(
    ("given", "words"), [("none", "segmenter: 'none'; give what make_seg"), (7, "a int; give what")]
)
def test_what_is_no_segmenter_is_refused(given: object, words: str) -> None:
    with pytest.raises(InputError, match=words):
        SlamSystem(CAMERA, segmenter=given)


def path(count: int, start_x_m: float = -0.6) -> list[Array]:
    """Camera poses sideways along the plane, 2 cm a frame, turning a little."""
    steps = np.arange(count)
    return [
        se3_exp(np.array([0.02 * np.sin(0.3 * i), 0.03 * np.sin(0.2 * i), 0.01 * i, 0, 0, 0]))
        @ se3_exp(np.array([0, 0, 0, start_x_m + 0.02 * i, 0.05 * np.sin(0.4 * i), 0.0]))
        for i in steps
    ]


def process_views(
    system: SlamSystem, poses: list[Array | None], first: int = 0
) -> list[FrameResult]:
    """Run the system along poses; None is a black frame without depth."""
    return [system.process(render_or_black(pose, first + i)) for i, pose in enumerate(poses)]


def largest_error_m(system: SlamSystem, poses: list[Array | None]) -> float:
    """Largest distance of a frame from the truth, both relative to the first frame."""
    trajectory = system.trajectory()
    index = np.rint(trajectory.timestamps_s * 30).astype(int)
    truth = [inverse(poses[index[0]]) @ poses[i] for i in index]
    start = inverse(trajectory.poses_world_camera[0])
    offsets = [
        se3_log(inverse(T_true) @ start @ T)
        for T_true, T in zip(truth, trajectory.poses_world_camera, strict=True)
    ]
    return float(np.linalg.norm(np.array(offsets)[:, 3:], axis=1).max())


def story(results: list[FrameResult]) -> list[tuple[int, EventKind]]:
    """The events but for those of loops and of the graph, and the frames that they are at."""
    of_tracking = (EventKind.LOST, EventKind.FOUND, EventKind.SEGMENT, EventKind.JOINED)
    events = [(r.index, e) for r in results for e in r.events]
    assert all(index == event.frame for index, event in events)
    return [(index, event.kind) for index, event in events if event.kind in of_tracking]


def test_pose_agrees_with_the_truth_in_frame_unit_and_sign() -> None:
    system, poses = SlamSystem(CAMERA), path(25)
    results = process_views(system, poses)
    assert all(r.status is TrackingStatus.OK for r in results)
    system.finish()
    assert len(system.trajectory()) == 25
    assert largest_error_m(system, poses) < 0.003
    T_first_last = inverse(poses[0]) @ poses[-1]
    assert np.allclose(results[-1].T_world_camera, T_first_last, atol=0.004)


def test_lost_frames_get_no_pose_and_tracking_recovers() -> None:
    system = SlamSystem(CAMERA)
    there = path(15)
    poses = [*there, *[None] * 5, *there[5:10]]
    results = process_views(system, poses)
    assert [r.status for r in results[15:20]] == [TrackingStatus.LOST] * 5
    assert all(r.T_world_camera is None for r in results[15:20])
    assert all(r.status is not TrackingStatus.LOST for r in results[20:])
    assert len(system.trajectory()) == 20
    assert {r.segment for r in results} == {0}
    assert largest_error_m(system, poses) < 0.003
    assert story(results) == [
        (0, EventKind.SEGMENT),
        (15, EventKind.LOST),
        (20, EventKind.FOUND),
    ]


def test_segments_are_kept_apart_until_one_is_recognised_in_the_other() -> None:
    system = SlamSystem(CAMERA, SystemConfig(FeatureConfig(max_keypoints=400)))
    here, other_path = path(12, start_x_m=-1.6), path(14, start_x_m=1.4)
    back = [path(1, start_x_m=x)[0] for x in np.arange(1.4, -1.61, -0.045)]
    poses = [*here, *[None] * 40, *other_path]  # time enough to walk 3 m
    results = process_views(system, poses)
    assert results[-1].segment == 1
    apart = system.segments()
    assert [len(apart[0]), len(apart[1])] == [12, sum(r.segment == 1 for r in results)]
    poses += [*other_path[::-1], *back]
    results += process_views(system, poses[len(results) :], first=len(results))
    assert results[-1].segment == 0
    joined = system.segments()
    assert list(joined) == [0]
    assert len(joined[0]) == sum(r.T_world_camera is not None for r in results)
    assert largest_error_m(system, poses) < 0.02  # a wrong join would be off by decimetres
    begun = next(r.index for r in results if r.segment == 1)
    last = max(r.index for r in results if r.segment == 1)
    assert story(results) == [
        (0, EventKind.SEGMENT),
        (12, EventKind.LOST),
        (begun, EventKind.SEGMENT),
        (last + 1, EventKind.JOINED),
    ]
    (joining,) = (e for r in results for e in r.events if e.kind is EventKind.JOINED)
    assert joining.text.startswith("segment 1 becomes part of segment 0, where ")
    assert joining.timestamp_s == results[last + 1].timestamp_s


def test_black_frames_before_the_first_keyframe_are_lost_not_fatal() -> None:
    results = process_views(SlamSystem(CAMERA), [None, None, *path(3)])
    expected = [TrackingStatus.LOST] * 2 + [TrackingStatus.OK] * 3
    assert [r.status for r in results] == expected
    assert results[2].keyframe_reason == "first frame"


def test_a_frame_without_depth_is_tracked_from_the_map() -> None:
    system, poses = SlamSystem(CAMERA), path(6)
    process_views(system, poses[:5])
    frame = render_plane(poses[5], 5)
    without_depth = Frame(5, frame.timestamp_s, frame.rgb, np.full((480, 640), np.nan, np.float32))
    result = system.process(without_depth)
    assert result.status is TrackingStatus.OK
    assert np.allclose(result.T_world_camera, inverse(poses[0]) @ poses[5], atol=0.01)


def test_features_prepared_ahead_change_nothing_and_runs_repeat() -> None:
    runs = []
    for ahead in (False, True):
        system = SlamSystem(CAMERA)
        for index, pose in enumerate(path(10)):
            frame = render_plane(pose, index)
            system.process(frame, system.prepare(frame) if ahead else None)
        system.finish()
        runs.append(system.trajectory().poses_world_camera.tobytes())
    assert runs[0] == runs[1]


def test_frames_of_culled_keyframes_keep_their_poses() -> None:
    every_frame = ["keyframes.max_shared=9.0", "keyframes.min_interval_frames=1"]
    system, poses = SlamSystem(CAMERA, resolve(SystemConfig, None, every_frame)), path(16)
    results = process_views(system, poses)
    assert len(system.mapper.world.keyframes) < sum(r.keyframe_id is not None for r in results)
    assert len(system.trajectory()) == 16
    assert largest_error_m(system, poses) < 0.003


def test_a_second_pass_needs_no_more_keyframes() -> None:
    system, there = SlamSystem(CAMERA), path(108)[::6]
    poses = [*there, *there[-2::-1]]
    made = np.array([r.keyframe_id is not None for r in process_views(system, poses)])
    assert made[: len(there)].sum() == 6
    assert not made[len(there) :].any()
    assert largest_error_m(system, poses) < 0.003
    assert system.camera_tracker.reference is not None
    assert system.camera_tracker.reference.id <= 2  # near the start again, not the last of six


@pytest.mark.parametrize(
    "override",
    [
        "features.layer_shares=[0.4, 0.3, 0.3]",
        "tracking.match.mutual=false",
        "tracking.match.max_angle_rad=0.4",
        "tracking.match.ratio=1.0",
        "tracking.subpixel.enabled=false",
        "keyframes.rule=paper",
        "graph.robust=false",
        "final_adjustment=false",
    ],
)
def test_tracking_works_with_every_option(override: str) -> None:
    poses = path(8)
    system = SlamSystem(CAMERA, resolve(SystemConfig, None, [override]))
    results = process_views(system, poses)
    system.finish()
    assert all(r.status is TrackingStatus.OK for r in results)
    assert largest_error_m(system, poses) < 0.006


def test_graph_is_saved_with_every_keyframe(tmp_path: Path) -> None:
    from bmask_slam.graph.smoother.smoother import Smoother

    system = SlamSystem(CAMERA)
    process_views(system, path(15))
    system.files()["graph"](tmp_path / "graph")
    estimate = Smoother.load(tmp_path / "graph").estimate()
    keyframes = system.keyframe_trajectory().poses_world_camera
    assert np.allclose(estimate.poses_world_camera, keyframes)
    assert len(estimate.landmark_ids) > 50


@pytest.mark.skipif(not KITCHEN.exists(), reason="needs ../shared/data/redkitchen")
def test_the_start_of_the_red_kitchen_is_tracked() -> None:
    from bmask_slam.evaluation import evaluate_trajectory

    sequence = open_sequence(KITCHEN)
    system = SlamSystem(sequence.camera)
    results = [system.process(frame) for frame in sequence.frames(stop=120, stride=3)]
    assert all(r.status is not TrackingStatus.LOST for r in results)
    errors = evaluate_trajectory(system.trajectory(), sequence.groundtruth)
    assert errors.value("ate_rmse") < 0.03


def test_depth_of_zero_is_missing_depth_and_a_stamp_must_go_forward() -> None:
    """Frames from a caller, with a segmenter whose masks cover pixels of depth 0."""
    frames = [render_plane(pose, i) for i, pose in enumerate(path(3))]
    results = []
    for missing in (0.0, np.nan):
        system = SlamSystem(CAMERA, segmenter=WholeImage())
        for frame in frames:
            depth_m = np.where(np.arange(640) % 7 == 0, np.float32(missing), frame.depth_m)
            result = system.process(replace(frame, depth_m=depth_m))
        results.append(result.T_world_camera)
    np.testing.assert_array_equal(*results)
    with pytest.raises(InputError, match="not later than the frame before"):
        system.process(frames[1])
    assert system.process(render_or_black(path(4)[3], 3)).status is TrackingStatus.OK


class WholeImage(NoSegmenter):
    """A segmenter: the whole image is one instance."""

    labels = label_set(("thing",))

    def segment(self, image: Image, name: str) -> list[Instance]:
        mask = np.ones(image.shape[:2], bool)
        found = certain(1, len(self.labels), 0.9)
        return [Instance(mask, mask_box(mask), 1, found, 0.9, 0.9)]


@pytest.mark.parametrize("faint", [True, False])
def test_real_frames_of_a_dark_room_are_tracked(faint: bool) -> None:
    """A fifth of the light of freiburg1_rpy, and the noise of a sensor."""
    sequence, rng = open_sequence(shared("tum_fr1_rpy")), np.random.default_rng(5)
    features = FeatureConfig() if faint else FeatureConfig(faint_thresholds=())
    system = SlamSystem(sequence.camera, replace(SystemConfig(), features=features))
    tracked = 0
    for k in range(60):
        frame = sequence.load(k)
        light = 0.2 * frame.rgb + rng.normal(0, 3, frame.rgb.shape)
        dark = np.clip(np.rint(light), 0, 255).astype(np.uint8)
        result = system.process(replace(frame, rgb=dark))
        tracked += result.status.by_image
    assert tracked == 60 if faint else tracked < 40
