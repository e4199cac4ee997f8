"""ISAM2 is made to fail by updates that are not validated, and the smoother must continue.

``validate`` is replaced by a function that accepts everything.
"""

import numpy as np
import pytest
from synthetic_room import CAMERA, make_room

import bmask_slam.graph.smoother.smoother
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.factors.factor_tables import FactorTables
from bmask_slam.graph.factors.graph_estimate import GraphEstimate, RefusalReason, Refusals
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.smoother.isam2 import SolverError
from bmask_slam.graph.smoother.repair import Repair
from bmask_slam.graph.smoother.smoother import Smoother, SmootherConfig
from bmask_slam.graph.smoother.validation import Validated

ROOM = make_room(keyframes=6, noise_px=0.3)


def accept_everything(
    update: GraphUpdate, tables: FactorTables, camera: Camera, config: SmootherConfig
) -> Validated:
    return Validated(
        update.keyframe_ids,
        update.poses_world_camera,
        update.landmark_ids,
        update.points_world,
        update.observations,
        (*update.priors, *update.relative_poses),
        Refusals(),
        (),
    )


@pytest.fixture
def smoother(monkeypatch: pytest.MonkeyPatch) -> Smoother:
    """Five keyframes in the graph, and no validation of later updates."""
    smoother = Smoother(CAMERA)
    for update in ROOM.updates()[:5]:
        smoother.update(update)
    monkeypatch.setattr(bmask_slam.graph.smoother.smoother, "validate", accept_everything)
    return smoother


def observe(keyframe: int, landmarks: list[int], measurements: Array) -> Observations:
    ids = np.array(landmarks)
    return Observations(np.full(len(ids), keyframe), ids, measurements, np.ones((len(ids), 3)))


def assert_continues(smoother: Smoother, failed: GraphEstimate) -> None:
    """The rest of the room is added, and the optimum equals that of an undisturbed run."""
    assert failed.rebuilt
    estimate = smoother.update(ROOM.update_of(5))
    assert not estimate.rebuilt
    assert estimate.keyframe_ids.tolist() == [0, 1, 2, 3, 4, 5]
    undisturbed = Smoother(CAMERA)
    for update in ROOM.updates():
        undisturbed.update(update)
    expected = undisturbed.optimise_batch()
    found = smoother.optimise_batch()
    np.testing.assert_array_equal(found.landmark_ids, expected.landmark_ids)
    difference = se3_log(inverse(found.poses_world_camera) @ expected.poses_world_camera)
    assert np.abs(difference).max() < 1e-5


def test_a_landmark_behind_the_camera_is_dropped(smoother: Smoother) -> None:
    behind = transform(smoother.estimate().poses_world_camera[4], np.array([[0.1, 0.1, -2.0]]))
    z = np.array([[330.0, 240.0, 315.0]])
    estimate = smoother.update(
        GraphUpdate(
            landmark_ids=np.array([900]), points_world=behind, observations=observe(4, [900], z)
        )
    )
    assert estimate.failed_variable == "landmark 900"
    assert estimate.dropped_landmarks.tolist() == [900]
    assert 900 not in estimate.landmark_ids
    assert_continues(smoother, estimate)


def test_many_bad_landmarks_are_dropped_at_once(smoother: Smoother) -> None:
    """More than can be dropped one by one as GTSAM reports them."""
    count = 3 * SmootherConfig().max_repairs
    behind = np.column_stack([np.linspace(-1, 1, count), np.zeros(count), np.full(count, -2.0)])
    ids = np.arange(900, 900 + count)
    z = np.tile([330.0, 240.0, 315.0], (count, 1))
    estimate = smoother.update(
        GraphUpdate(
            landmark_ids=ids,
            points_world=transform(smoother.estimate().poses_world_camera[4], behind),
            observations=observe(4, ids.tolist(), z),
        )
    )
    assert estimate.dropped_landmarks.tolist() == ids.tolist()
    assert_continues(smoother, estimate)


def test_a_landmark_with_one_monocular_view_is_dropped(smoother: Smoother) -> None:
    point = transform(smoother.estimate().poses_world_camera[4], np.array([[0.1, 0.1, 2.0]]))
    estimate = smoother.update(
        GraphUpdate(
            landmark_ids=np.array([900]),
            points_world=point,
            observations=observe(4, [900], np.array([[330.0, 240.0, np.nan]])),
        )
    )
    assert estimate.failed_variable == "landmark 900"
    assert estimate.dropped_landmarks.tolist() == [900]
    assert_continues(smoother, estimate)


def test_a_pose_with_one_point_is_dropped_although_gtsam_names_the_point(
    smoother: Smoother,
) -> None:
    known = int(smoother.estimate().landmark_ids[3])
    estimate = smoother.update(
        GraphUpdate(
            np.array([50]),
            ROOM.poses_world_camera[[4]],
            observations=observe(50, [known], np.array([[330.0, 240.0, 315.0]])),
        )
    )
    assert estimate.dropped_keyframes.tolist() == [50]
    assert estimate.dropped_landmarks.tolist() == []
    assert known in estimate.landmark_ids
    assert_continues(smoother, estimate)


def test_a_segment_connected_by_one_point_is_dropped(smoother: Smoother) -> None:
    """Every new keyframe has many landmarks, but the segment can rotate about a single point."""
    before = smoother.estimate()
    far = ROOM.moved(se3_exp(np.array([0.0, 0.0, 0.0, 40.0, 0.0, 0.0])))
    observed = far.observations
    few = observed.select(observed.keyframe_ids < 3)
    known = int(before.landmark_ids[3])
    hinge = observe(50, [known], np.array([[330.0, 240.0, 315.0]]))
    new = np.unique(few.landmark_ids)
    columns = [
        np.concatenate([getattr(few, name) + shift, getattr(hinge, name)])
        for name, shift in (("keyframe_ids", 50), ("landmark_ids", 1000))
    ]
    observations = Observations(
        *columns,
        np.concatenate([few.measurements, hinge.measurements]),
        np.concatenate([few.sigmas_px, hinge.sigmas_px]),
    )
    estimate = smoother.update(
        GraphUpdate(
            50 + np.arange(3),
            far.initial_poses[:3],
            1000 + new,
            far.initial_points[new],
            observations,
        )
    )
    np.testing.assert_array_equal(estimate.keyframe_ids, before.keyframe_ids)
    np.testing.assert_array_equal(estimate.landmark_ids, before.landmark_ids)
    assert estimate.dropped_keyframes.tolist() == [50, 51, 52]
    assert_continues(smoother, estimate)


def test_a_nan_measurement_is_found_although_gtsam_names_another(smoother: Smoother) -> None:
    before = smoother.estimate()
    point = transform(before.poses_world_camera[4], np.array([[0.1, 0.1, 2.0]]))
    estimate = smoother.update(
        GraphUpdate(
            landmark_ids=np.array([900]),
            points_world=point,
            observations=observe(4, [900], np.array([[np.nan, 240.0, 315.0]])),
        )
    )
    np.testing.assert_array_equal(estimate.landmark_ids, before.landmark_ids)
    assert_continues(smoother, estimate)


def test_an_update_that_cannot_be_repaired_is_removed_as_a_whole(
    smoother: Smoother, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = np.zeros(0, np.int64)
    monkeypatch.setattr(
        bmask_slam.graph.smoother.smoother, "repair", lambda *_: Repair(none, none, none)
    )
    before = smoother.estimate()
    known = int(before.landmark_ids[3])
    estimate = smoother.update(
        GraphUpdate(
            np.array([50]),
            ROOM.poses_world_camera[[4]],
            observations=observe(50, [known], np.array([[330.0, 240.0, 315.0]])),
        )
    )
    assert estimate.refused.count(RefusalReason.SOLVER_FAILED) == 2
    assert "1 observations refused: solver failed" in estimate.notes()
    assert estimate.notes()[-1].startswith("rebuilt after a failure near ")
    np.testing.assert_array_equal(estimate.keyframe_ids, before.keyframe_ids)
    np.testing.assert_array_equal(estimate.landmark_ids, before.landmark_ids)
    assert_continues(smoother, estimate)


def test_a_batch_optimisation_is_repaired_too(smoother: Smoother) -> None:
    expected = smoother.optimise_batch()
    row = 40
    observations = smoother._tables.observations.select(np.array([row]))
    observations.measurements[0, 0] = np.nan
    smoother._tables.observations.remove(np.array([row]))
    smoother._tables.observations.add(observations)
    found = smoother.optimise_batch()
    assert found.rebuilt
    assert found.factors == expected.factors - 1
    assert np.isfinite(found.cost_after)
    np.testing.assert_allclose(found.poses_world_camera, expected.poses_world_camera, atol=2e-3)


def test_a_failed_batch_optimisation_keeps_the_values(
    smoother: Smoother, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise SolverError("planted", None)

    before = smoother.estimate()
    monkeypatch.setattr(smoother._solver, "optimise_batch", fail)
    after = smoother.optimise_batch()
    assert np.isnan(after.cost_after)
    np.testing.assert_array_equal(after.points_world, before.points_world)
