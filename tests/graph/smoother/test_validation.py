"""Each reason to refuse a factor, and that nothing else is refused."""

import dataclasses
import math

import numpy as np
import pytest
from synthetic_room import CAMERA, make_room

from bmask_slam.graph.factors.graph_estimate import NO_LANDMARK, RefusalReason
from bmask_slam.graph.factors.graph_update import GraphUpdate, Observations, PosePrior, RelativePose
from bmask_slam.graph.factors.observability import constrained_landmarks
from bmask_slam.graph.geometry import make_pose
from bmask_slam.graph.smoother.smoother import Smoother

ROOM = make_room(keyframes=4)
NEXT = ROOM.update_of(3)


@pytest.fixture
def smoother() -> Smoother:
    smoother = Smoother(CAMERA)
    for update in ROOM.updates()[:3]:
        assert len(smoother.update(update).refused) == 0
    return smoother


def changed(row: int, **columns: object) -> GraphUpdate:
    """The next update with one observation changed."""
    values = {}
    for name, value in columns.items():
        column = getattr(NEXT.observations, name).copy()
        column[row] = value
        values[name] = column
    return dataclasses.replace(NEXT, observations=dataclasses.replace(NEXT.observations, **values))


def in_the_graph(smoother: Smoother) -> int:
    """A row of the next update that concerns a landmark already in the graph."""
    return int(np.flatnonzero(np.isin(NEXT.observations.landmark_ids, graph_ids(smoother)))[4])


def graph_ids(smoother: Smoother) -> np.ndarray:
    return smoother.estimate().landmark_ids


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"measurements": [np.nan, 200.0, 300.0]}, RefusalReason.NOT_FINITE),
        ({"measurements": [300.0, np.inf, 290.0]}, RefusalReason.NOT_FINITE),
        ({"measurements": [300.0, 200.0, np.inf]}, RefusalReason.NOT_FINITE),
        ({"sigmas_px": [1.0, 0.0, 1.0]}, RefusalReason.NOT_FINITE),
        ({"sigmas_px": [1.0, 1.0, np.nan]}, RefusalReason.NOT_FINITE),
        ({"keyframe_ids": 77}, RefusalReason.UNKNOWN_KEYFRAME),
        ({"landmark_ids": 5555}, RefusalReason.UNKNOWN_LANDMARK),
        ({"measurements": [300.0, 9000.0, 290.0]}, RefusalReason.REPROJECTION),
    ],
)
def test_only_the_bad_observation_is_refused(
    smoother: Smoother, columns: dict[str, object], reason: RefusalReason
) -> None:
    estimate = smoother.update(changed(in_the_graph(smoother), **columns))
    assert estimate.refused.reasons.tolist() == [reason]
    assert 3 in estimate.keyframe_ids


def test_a_monocular_view_needs_no_disparity_sigma(smoother: Smoother) -> None:
    row = in_the_graph(smoother)
    z = NEXT.observations.measurements[row].copy()
    z[2] = np.nan
    update = changed(row, measurements=z, sigmas_px=[1.0, 1.0, np.nan])
    assert len(smoother.update(update).refused) == 0


def test_a_repeated_observation_is_added_once(smoother: Smoother) -> None:
    observed = NEXT.observations
    doubled = observed.select(np.array([0, 1, 1, *range(2, len(observed))]))
    estimate = smoother.update(dataclasses.replace(NEXT, observations=doubled))
    assert estimate.refused.reasons.tolist() == [RefusalReason.DUPLICATE]


@pytest.mark.parametrize(
    ("z_m", "reason"),
    [
        (-2.0, RefusalReason.BEHIND_CAMERA),
        (0.01, RefusalReason.BEHIND_CAMERA),
        (100.0, RefusalReason.OUT_OF_RANGE),
    ],
)
def test_points_behind_the_camera_are_refused_by_depth(
    smoother: Smoother, z_m: float, reason: RefusalReason
) -> None:
    T_world_camera = smoother.estimate().poses_world_camera[2]
    point = T_world_camera[:3, 3] + z_m * T_world_camera[:3, 2]
    observed = Observations(
        np.array([2]), np.array([900]), np.array([[318.5, 241.5, 310.0]]), np.ones((1, 3))
    )
    update = GraphUpdate(
        landmark_ids=np.array([900]), points_world=point[None], observations=observed
    )
    estimate = smoother.update(update)
    assert estimate.refused.reasons.tolist() == [reason]
    assert 900 not in estimate.landmark_ids


def test_a_stereo_view_that_contradicts_a_new_point_is_refused(smoother: Smoother) -> None:
    """At twice the disparity a Gauss-Newton step would put the point behind the camera."""
    T_world_camera = smoother.estimate().poses_world_camera[2]
    point = T_world_camera[:3, 3] + 4.0 * T_world_camera[:3, 2]
    observed = Observations(
        np.array([2]), np.array([900]), np.array([[318.5, 241.5, 297.5]]), np.ones((1, 3))
    )
    update = GraphUpdate(
        landmark_ids=np.array([900]), points_world=point[None], observations=observed
    )
    assert smoother.update(update).refused.reasons.tolist() == [RefusalReason.REPROJECTION]


@pytest.mark.parametrize(("baseline_m", "enters"), [(0.02, False), (0.2, True)])
def test_a_monocular_landmark_needs_parallax(baseline_m: float, enters: bool) -> None:
    """Straight ahead at 5 m: 0.2 m aside is 2.3 degrees, 0.02 m is 0.23."""
    poses = make_pose(np.eye(3), np.array([[0.0, 0.0, 0.0], [baseline_m, 0.0, 0.0]]))
    points = np.vstack([ROOM.points_world[:20] + 5.0 * np.eye(3)[2], 5.0 * np.eye(3)[2]])
    ids = np.tile(np.arange(21), 2)
    keyframes = np.repeat([0, 1], 21)
    z = CAMERA.project_stereo(points[ids] - poses[keyframes, :3, 3])
    z[ids == 20, 2] = np.nan
    update = GraphUpdate(
        np.arange(2),
        poses,
        np.arange(21),
        points,
        Observations(keyframes, ids, z, np.ones((42, 3))),
    )
    estimate = Smoother(CAMERA).update(update)
    assert (20 in estimate.landmark_ids) == enters
    refused = estimate.refused.count(RefusalReason.LANDMARK_UNDERCONSTRAINED)
    assert refused == len(estimate.refused) == (0 if enters else 2)


def test_parallax_of_many_landmarks_equals_a_loop() -> None:
    rng = np.random.default_rng(1)
    count = 300
    centres, points = rng.normal(0, 0.05, (6, 3)), rng.uniform(2, 6, (100, 3))
    keyframes, landmarks = rng.integers(0, 6, count), rng.integers(0, 100, count)
    z = np.where(rng.random((count, 1)) < 0.05, 1.0, [[1.0, 1.0, np.nan]])
    poses = make_pose(np.eye(3), centres)
    found = constrained_landmarks(
        Observations(keyframes, landmarks, z, np.ones((count, 3))),
        poses[keyframes],
        points[landmarks],
        1.0,
    )
    expected = []
    for j in range(100):
        rows = np.flatnonzero(landmarks == j)
        rows = rows[np.argsort(keyframes[rows], kind="stable")]  # the order of rows says nothing
        rays = [points[j] - centres[keyframes[row]] for row in rows]
        rays = [ray / np.linalg.norm(ray) for ray in rays]
        angles = [math.degrees(math.acos(min(1.0, float(rays[0] @ ray)))) for ray in rays]
        if len(rows) and (np.isfinite(z[rows, 2]).any() or max(angles) >= 1.0):
            expected.append(j)
    assert 10 < len(expected) < 90
    assert found.tolist() == expected


def test_an_underconstrained_keyframe_is_refused(smoother: Smoother) -> None:
    """New landmarks do not constrain the keyframe."""
    known = np.isin(NEXT.observations.landmark_ids, graph_ids(smoother))
    few = np.concatenate([np.flatnonzero(known)[:5], np.flatnonzero(~known)])
    first = few[:5]
    made_up = GraphUpdate(
        NEXT.keyframe_ids,
        NEXT.poses_world_camera,
        2000 + np.arange(40),
        ROOM.points_world[:40],
        Observations(
            np.full(45, 3),
            np.concatenate([NEXT.observations.landmark_ids[first], 2000 + np.arange(40)]),
            np.concatenate(
                [
                    NEXT.observations.measurements[first],
                    CAMERA.project_stereo(observed_from(3, ROOM.points_world[:40])),
                ]
            ),
            np.ones((45, 3)),
        ),
    )
    estimate = smoother.update(made_up)
    assert 3 not in estimate.keyframe_ids
    assert (estimate.landmark_ids < 2000).all()
    whole = estimate.refused.landmark_ids == NO_LANDMARK
    assert estimate.refused.keyframe_ids[whole].tolist() == [3]
    assert estimate.refused.reasons[whole].tolist() == [RefusalReason.KEYFRAME_UNDERCONSTRAINED]
    T_a_b = np.linalg.inv(ROOM.poses_world_camera[2]) @ ROOM.poses_world_camera[3]
    anchored = dataclasses.replace(
        made_up, relative_poses=(RelativePose(2, 3, T_a_b, 1e-4 * np.eye(6)),)
    )
    assert 3 in smoother.update(anchored).keyframe_ids


def observed_from(keyframe: int, points_world: np.ndarray) -> np.ndarray:
    T_world_camera = ROOM.poses_world_camera[keyframe]
    return (points_world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]


@pytest.mark.parametrize("spoil", ["nan", "scaled", "mirrored"])
def test_a_new_pose_that_is_not_rigid_is_refused(smoother: Smoother, spoil: str) -> None:
    T = NEXT.poses_world_camera.copy()
    T[0, :3, :3] *= {"nan": np.nan, "scaled": 1.1, "mirrored": -1.0}[spoil]
    estimate = smoother.update(dataclasses.replace(NEXT, poses_world_camera=T))
    assert estimate.keyframe_ids.tolist() == [0, 1, 2]
    whole = estimate.refused.landmark_ids == NO_LANDMARK
    assert estimate.refused.reasons[whole].tolist() == [RefusalReason.NOT_FINITE]
    assert smoother.update(NEXT).keyframe_ids.tolist() == [0, 1, 2, 3]


def test_a_known_keyframe_keeps_its_pose(smoother: Smoother) -> None:
    moved = dataclasses.replace(ROOM.update_of(2), poses_world_camera=np.eye(4)[None])
    before = smoother.estimate()
    estimate = smoother.update(moved)
    assert set(estimate.refused.reasons.tolist()) == {RefusalReason.DUPLICATE}
    np.testing.assert_allclose(
        estimate.poses_world_camera[2], before.poses_world_camera[2], atol=1e-3
    )


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"keyframe_b": 99}, RefusalReason.UNKNOWN_KEYFRAME),
        ({"keyframe_b": 0}, RefusalReason.DUPLICATE),
        ({"T_a_b": np.full((4, 4), np.nan)}, RefusalReason.NOT_FINITE),
        ({"covariance": np.zeros((6, 6))}, RefusalReason.BAD_COVARIANCE),
        ({"covariance": np.triu(np.ones((6, 6)))}, RefusalReason.BAD_COVARIANCE),
        ({"covariance": np.full((6, 6), np.nan)}, RefusalReason.BAD_COVARIANCE),
    ],
)
def test_a_bad_relative_pose_is_refused(
    smoother: Smoother, changes: dict[str, object], reason: RefusalReason
) -> None:
    edge = dataclasses.replace(RelativePose(0, 2, np.eye(4), np.eye(6), kind="loop"), **changes)
    before = smoother.estimate().factors
    estimate = smoother.update(GraphUpdate(relative_poses=(edge,)))
    assert [(f.kind, f.reason) for f in estimate.refused_factors] == [("loop", reason)]
    assert estimate.factors == before


def test_a_prior_on_an_unknown_keyframe_is_refused(smoother: Smoother) -> None:
    prior = PosePrior(99, np.eye(4), np.eye(6))
    (refused,) = smoother.update(GraphUpdate(priors=(prior,))).refused_factors
    assert refused.kind == "prior"
    assert refused.keyframe_ids == (99,)
    assert refused.reason == RefusalReason.UNKNOWN_KEYFRAME
