"""Selection of factors and reading back of estimates, with the real smoother."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_view import CAMERA, add_keyframe, make_features, points_before, random_descriptors

from bmask_slam.back_end.factor_selection import FactorSelectionConfig, FactorSelector, read_back
from bmask_slam.back_end.factors import observations_of, quantised, stereo_measurements
from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import DepthNoise
from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import ANCHOR, GraphUpdate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.graph.smoother.smoother import Smoother
from bmask_slam.world.world_map import WorldMap

RNG = np.random.default_rng(21)
COUNT = 60
EVERYTHING = FactorSelectionConfig(max_observations=1000, min_views=2)


def pose_of(k: int) -> Array:
    """True poses: sideways, with a slight turn."""
    return se3_exp(np.array([0.01 * k, -0.02 * k, 0.0, 0.05 * k, 0.01 * k, 0.02 * k]))


def make_world(keyframes: int, count: int = COUNT) -> tuple[WorldMap, Array]:
    """Keyframe k observes point i with keypoint i; landmark i is made by the first; exact."""
    points = points_before(np.eye(4), count, RNG)
    world = WorldMap()
    for k in range(keyframes):
        features = make_features(pose_of(k), points, random_descriptors(count, RNG))
        keyframe = add_keyframe(world, pose_of(k), features)
        rows = np.arange(count)
        if k == 0:
            world.make_landmarks(keyframe, rows, points)
        else:
            world.attach(keyframe, rows, rows)
    return world, points


def pairs(update: GraphUpdate) -> set[tuple[int, int]]:
    """(keyframe, landmark) of every observation; none may be sent twice."""
    sent = list(map(tuple, update.observations.pairs.tolist()))
    assert len(sent) == len(set(sent))
    return set(sent)


def pairs_of(world: WorldMap) -> set[tuple[int, int]]:
    return {(k.id, i) for k in world.keyframes.values() for i in world.observed(k)[1].tolist()}


def estimate_of(world: WorldMap, landmark_ids: Array, T_correction: Array) -> GraphEstimate:
    """The map as it is, moved rigidly, as the graph's answer with these landmarks."""
    poses = np.array([k.T_world_camera for k in world.keyframes.values()])
    return GraphEstimate(
        np.array(list(world.keyframes)),
        T_correction @ poses,
        landmark_ids,
        transform(T_correction, world.landmarks.points_world[landmark_ids]),
    )


def test_measurements_are_those_of_the_stereo_camera() -> None:
    """Also with noise: u_right is the noisy u minus the noisy disparity."""
    points = points_before(np.eye(4), 20, RNG)
    noise = RNG.normal(size=(20, 3)) * [0.7, 0.7, 0.12]
    features = make_features(np.eye(4), points, random_descriptors(20, RNG), noise)
    rows = np.array([3, 1, 7])
    expected = CAMERA.project_stereo(points[rows])
    expected += np.column_stack([noise[rows, :2], noise[rows, 0] - noise[rows, 2]])
    np.testing.assert_allclose(stereo_measurements(features, rows), expected, atol=1e-9)
    features.disparity_px[1] = np.nan
    assert np.isnan(stereo_measurements(features, rows)[:, 2]).tolist() == [False, True, False]


def test_quantised_sigmas_are_few_and_near() -> None:
    sigmas = np.exp(RNG.uniform(np.log(0.1), np.log(5), (500, 3)))
    rounded = quantised(sigmas)
    assert np.abs(np.log2(rounded / sigmas)).max() <= 1 / 6 + 1e-12
    assert len(np.unique(rounded)) <= 18
    np.testing.assert_allclose(quantised(np.array([1.0, 0.5, 2.0])), [1.0, 0.5, 2.0])


def test_observations_belong_to_their_keypoints() -> None:
    world, points = make_world(2)
    keyframe = world.keyframes[1]
    observations = observations_of(keyframe, np.array([9, 4]), np.array([9, 4]))
    assert observations.keyframe_ids.tolist() == [1, 1]
    assert observations.landmark_ids.tolist() == [9, 4]
    expected = CAMERA.project_stereo(transform(inverse(pose_of(1)), points[[9, 4]]))
    np.testing.assert_allclose(observations.measurements, expected, atol=1e-9)


def test_only_the_depth_counts_less_by_the_cameras_factor() -> None:
    world, _ = make_world(2)
    rows = np.array([9, 4])
    plain = observations_of(world.keyframes[1], rows, rows)
    factor = replace(CAMERA, depth_noise=DepthNoise(c_per_m=0.002, in_graph=2.0)).graph_depth_factor
    less = observations_of(world.keyframes[1], rows, rows, factor)
    np.testing.assert_allclose(less.sigmas_px, plain.sigmas_px * [1, 1, 2])
    assert CAMERA.graph_depth_factor == 1


def test_a_landmark_is_added_at_its_second_observation_with_all() -> None:
    world, _ = make_world(1)
    factor_selection = FactorSelector(EVERYTHING)
    first = factor_selection.keyframe_update(world, world.keyframes[0])
    assert len(first.landmark_ids) == 0
    assert [p.keyframe_id for p in first.priors] == [0]
    features = make_features(pose_of(1), world.landmarks.points_world, random_descriptors(60, RNG))
    keyframe = add_keyframe(world, pose_of(1), features)
    world.attach(keyframe, np.arange(10), np.arange(10))
    second = factor_selection.keyframe_update(world, keyframe)
    assert second.landmark_ids.tolist() == list(range(10))
    assert pairs(second) == {(k, i) for k in (0, 1) for i in range(10)}
    assert second.priors == ()
    np.testing.assert_array_equal(second.points_world, world.landmarks.points_world[:10])


def test_the_frame_of_a_segment_is_as_firm_as_configured() -> None:
    world, _ = make_world(1)
    graph = SmootherConfig(prior_sigma_rotation_rad=2e-3, prior_sigma_translation_m=3e-3)
    selector = FactorSelector(EVERYTHING, graph=graph)
    (prior,) = selector.keyframe_update(world, world.keyframes[0]).priors
    sigmas = np.repeat([2e-3, 3e-3], 3)
    np.testing.assert_allclose(prior.covariance, np.diag(sigmas**2))


def test_every_observation_is_sent_exactly_once() -> None:
    """Landmarks are added and removed from keyframe to keyframe."""
    world, points = WorldMap(), points_before(np.eye(4), COUNT, RNG)
    factor_selection, sent = FactorSelector(EVERYTHING), set()
    for k in range(6):
        features = make_features(pose_of(k), points, random_descriptors(COUNT, RNG))
        keyframe = add_keyframe(world, pose_of(k), features)
        if k == 0:
            world.make_landmarks(keyframe, np.arange(COUNT), points)
        else:
            rows = RNG.permutation(COUNT)[:35]
            world.attach(keyframe, rows, rows)
        update = factor_selection.keyframe_update(world, keyframe)
        assert not sent & pairs(update)
        sent |= pairs(update)
    twice = np.flatnonzero(world.landmarks.observations >= 2)
    assert sent == {(k, i) for k, i in pairs_of(world) if i in twice}


def test_observations_in_keyframes_older_than_the_landmark_are_sent() -> None:
    """A new landmark found again in an older neighbour has its second view there."""
    world, _ = make_world(3, count=40)
    factor_selection = FactorSelector(EVERYTHING)
    for k in (0, 1, 2):
        world.landmarks.in_graph[:] = True
        factor_selection.keyframe_update(world, world.keyframes[k])
    points = points_before(np.eye(4), 20, RNG)
    old, new = (
        add_keyframe(
            world, pose_of(k), make_features(pose_of(k), points, random_descriptors(20, RNG))
        )
        for k in (3, 4)
    )
    ids = world.make_landmarks(new, np.arange(20), points)
    world.attach(old, np.arange(20), ids)
    update = factor_selection.keyframe_update(world, new)
    assert update.landmark_ids.tolist() == ids.tolist()
    assert pairs(update) == {(k, i) for k in (old.id, new.id) for i in ids.tolist()}


def test_observations_older_than_a_parent_are_sent() -> None:
    """The keyframe that made a landmark is culled; its parent is newer than another observer."""
    world, _ = make_world(4, count=20)
    world.remove_keyframe(world.keyframes[0], parent=world.keyframes[2])
    update = FactorSelector(EVERYTHING).keyframe_update(world, world.keyframes[3])
    assert pairs(update) == pairs_of(world)


def test_the_cap_bounds_landmarks_and_spreads_them() -> None:
    world, _ = make_world(3, count=400)
    config = FactorSelectionConfig(max_observations=50, min_views=2, bucket_px=80)
    update = FactorSelector(config).keyframe_update(world, world.keyframes[2])
    assert len(update.landmark_ids) == 50
    assert np.array_equal(np.flatnonzero(world.landmarks.in_graph), update.landmark_ids)
    buckets = world.keyframes[2].features.image_pixels // 80
    covered = {tuple(b) for b in buckets[update.landmark_ids].tolist()}
    occupied = {tuple(b) for b in buckets.tolist()}
    assert len(covered) == min(len(occupied), 50)


def test_landmarks_in_the_graph_count_towards_the_cap() -> None:
    world, _ = make_world(3, count=100)
    world.landmarks.in_graph[:45] = True
    config = FactorSelectionConfig(max_observations=50)
    update = FactorSelector(config).keyframe_update(world, world.keyframes[2])
    assert len(update.landmark_ids) == 5
    assert {(2, i) for i in range(45)} <= pairs(update)


def test_removed_landmarks_are_removed_once() -> None:
    world, _ = make_world(3)
    factor_selection = FactorSelector(EVERYTHING)
    factor_selection.remove_landmarks(np.array([4, 5]))
    factor_selection.remove_landmarks(np.array([8]))
    factor_selection.remove_keyframe(1)
    update = factor_selection.keyframe_update(world, world.keyframes[2])
    assert update.remove_landmarks.tolist() == [4, 5, 8]
    assert update.remove_keyframes.tolist() == [1]
    update = factor_selection.keyframe_update(world, world.keyframes[2])
    assert len(update.remove_landmarks) == len(update.remove_keyframes) == 0


def test_a_segments_first_keyframe_has_a_prior() -> None:
    world, points = make_world(2)
    features = make_features(np.eye(4), points, random_descriptors(COUNT, RNG))
    T = se3_exp(RNG.normal(size=6))
    keyframe = add_keyframe(world, T, features, segment=1)
    (prior,) = FactorSelector(EVERYTHING).keyframe_update(world, keyframe).priors
    assert prior.keyframe_id == keyframe.id
    np.testing.assert_array_equal(prior.T_world_camera, T)


def test_poses_and_points_are_read_back() -> None:
    world, _ = make_world(3)
    before = world.landmarks.points_world.copy()
    T_correction = se3_exp(np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05]))
    world.landmarks.in_graph[:20] = True
    inside = np.arange(0, 20)
    read_back(world, estimate_of(world, inside, T_correction))
    for k, keyframe in world.keyframes.items():
        np.testing.assert_allclose(keyframe.T_world_camera, T_correction @ pose_of(k), atol=1e-12)
    # those in the graph come from it, the others move with their host: both rigidly here
    moved = transform(T_correction, before)
    np.testing.assert_allclose(world.landmarks.points_world, moved, atol=1e-12)
    assert np.flatnonzero(world.landmarks.in_graph).tolist() == inside.tolist()


def test_landmarks_outside_the_graph_move_with_their_host() -> None:
    world, _ = make_world(2)
    world.landmarks.host[30:] = 1
    before = world.landmarks.points_world.copy()
    estimate = estimate_of(world, np.zeros(0, np.int64), np.eye(4))
    T_step = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.3, 0.0]))
    estimate.poses_world_camera[1] = T_step @ estimate.poses_world_camera[1]
    read_back(world, estimate)
    np.testing.assert_array_equal(world.landmarks.points_world[:30], before[:30])
    np.testing.assert_allclose(
        world.landmarks.points_world[30:], transform(T_step, before[30:]), atol=1e-12
    )


def test_refused_landmarks_move_with_their_host() -> None:
    """They were sent (in_graph is set) but the estimate does not hold them."""
    world, _ = make_world(3)
    before = world.landmarks.points_world.copy()
    world.landmarks.in_graph[:] = True
    T_correction = se3_exp(np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05]))
    read_back(world, estimate_of(world, np.arange(40), T_correction))
    moved = transform(T_correction, before)
    np.testing.assert_allclose(world.landmarks.points_world, moved, atol=1e-12)
    assert np.flatnonzero(world.landmarks.in_graph).tolist() == list(range(40))


def test_removed_landmarks_are_not_moved() -> None:
    world, _ = make_world(2)
    world.landmarks.remove(np.array([3]))
    before = world.landmarks.points_world[3].copy()
    T_correction = se3_exp(np.array([0, 0, 0, 0.1, 0, 0]))
    read_back(world, estimate_of(world, np.arange(COUNT), T_correction))
    np.testing.assert_array_equal(world.landmarks.points_world[3], before)
    assert not world.landmarks.in_graph[3]


@pytest.mark.parametrize("whole", [False, True])
def test_the_smoother_corrects_disturbed_poses(whole: bool) -> None:
    """Map, factor selection, graph and read-back with exact measurements give the truth."""
    world, points = make_world(1)
    factor_selection, smoother = FactorSelector(EVERYTHING), Smoother(CAMERA)
    read_back(world, smoother.update(factor_selection.keyframe_update(world, world.keyframes[0])))
    for k in range(1, 5):
        features = make_features(pose_of(k), points, random_descriptors(COUNT, RNG))
        disturbed = pose_of(k) @ se3_exp(RNG.normal(0, [0.003] * 3 + [0.01] * 3))
        keyframe = add_keyframe(world, disturbed, features)
        world.attach(keyframe, np.arange(COUNT), np.arange(COUNT))
        estimate = smoother.update(factor_selection.keyframe_update(world, keyframe))
        assert len(estimate.refused) == 0
        read_back(world, estimate)
    if whole:
        smoother = Smoother(CAMERA)
        estimate = smoother.update(factor_selection.whole_update(world))
        assert estimate.landmark_ids.tolist() == list(range(COUNT))
    read_back(world, smoother.optimise_batch())
    for k, keyframe in world.keyframes.items():
        assert np.abs(se3_log(inverse(pose_of(k)) @ keyframe.T_world_camera)).max() < 1e-4
    np.testing.assert_allclose(world.landmarks.points_world, points, atol=1e-3)


def test_a_keyframe_that_shares_next_to_nothing_is_held_and_the_graph_goes_on() -> None:
    """Behind a door all is new: it and those that follow are in the graph; a loop frees it."""
    world, points = make_world(0)
    selector, smoother = FactorSelector(EVERYTHING), Smoother(CAMERA)
    shown = np.zeros((9, COUNT), bool)
    shown[:4, :30], shown[4:, 27:], shown[8] = True, True, True  # 3 in common, less than 6
    ids = np.full(COUNT, -1)
    for k in range(9):
        rows = np.flatnonzero(shown[k])
        features = make_features(pose_of(k), points, random_descriptors(COUNT, RNG))
        keyframe = add_keyframe(world, pose_of(k), features)
        new = rows[ids[rows] < 0]
        world.attach(keyframe, np.setdiff1d(rows, new), ids[np.setdiff1d(rows, new)])
        ids[new] = world.make_landmarks(keyframe, new, points[new])
        estimate = smoother.update(selector.keyframe_update(world, keyframe))
        read_back(world, estimate)
        assert len(estimate.refused) == 0
        assert estimate.keyframe_ids.tolist() == list(range(k + 1))
        anchored = [(p.keyframe_a, p.keyframe_b) for p in smoother.relative_poses(ANCHOR)]
        assert anchored == ([(3, 4)] if 4 <= k < 8 else [])
    for k, keyframe in world.keyframes.items():
        assert np.abs(se3_log(inverse(pose_of(k)) @ keyframe.T_world_camera)).max() < 1e-3


def windowed_world(config: FactorSelectionConfig) -> tuple[WorldMap, FactorSelector, Smoother]:
    """Six keyframes of one wall, then three without common landmarks, in the graph."""
    world, points = make_world(0)
    factor_selection, smoother = FactorSelector(config), Smoother(CAMERA)
    walls = [(points, 6), (points_before(np.eye(4), COUNT, RNG), 3)]
    for wall, (points, keyframes) in enumerate(walls):
        T_away = se3_exp(np.array([0, 0, 0, 30.0 * wall, 0, 0]))
        for k in range(keyframes):
            T = T_away @ pose_of(k)
            features = make_features(pose_of(k), points, random_descriptors(COUNT, RNG))
            keyframe = add_keyframe(world, T, features)
            ids = wall * COUNT + np.arange(COUNT)
            if k == 0:
                world.make_landmarks(keyframe, np.arange(COUNT), transform(T_away, points))
            else:
                world.attach(keyframe, np.arange(COUNT), ids)
            keyframe.segment = wall
            read_back(world, smoother.update(factor_selection.keyframe_update(world, keyframe)))
    return world, factor_selection, smoother


WINDOWED = FactorSelectionConfig(full_keyframes=0, window_keyframes=3, marginalise_batch=COUNT // 2)


def test_a_small_map_keeps_every_landmark_in_the_graph() -> None:
    world, _, smoother = windowed_world(replace(WINDOWED, full_keyframes=100))
    assert world.landmarks.in_graph.all()
    assert len(smoother.estimate().landmark_ids) == 2 * COUNT


@pytest.mark.parametrize(("batch", "count"), [(7, 14), (1, 2 * COUNT)])
def test_two_batches_are_marginalised_at_once_or_all_where_very_many_wait(
    monkeypatch: pytest.MonkeyPatch, batch: int, count: int
) -> None:
    monkeypatch.setattr("bmask_slam.back_end.factor_selection.MANY_BATCHES", 20)
    config = replace(WINDOWED, marginalise_batch=batch)
    world, factor_selection, _ = windowed_world(replace(config, full_keyframes=100))
    factor_selection.config = config
    features = make_features(pose_of(5), np.zeros((0, 3)), np.zeros((0, 8), np.uint64))
    update = factor_selection.keyframe_update(world, add_keyframe(world, pose_of(5), features))
    assert len(update.marginalise_landmarks) == count


def test_landmarks_outside_the_window_are_marginalised_and_restored() -> None:
    world, factor_selection, smoother = windowed_world(WINDOWED)
    old, new = np.arange(COUNT), COUNT + np.arange(COUNT)
    assert not world.landmarks.in_graph[old].any()
    assert world.landmarks.in_graph[new].all()
    assert world.landmarks.in_map.all()
    assert smoother.estimate().landmark_ids.tolist() == new.tolist()
    features = make_features(
        pose_of(6), world.landmarks.points_world[old], random_descriptors(COUNT, RNG)
    )
    keyframe = add_keyframe(world, pose_of(6), features)
    world.attach(keyframe, old, old)
    update = factor_selection.keyframe_update(world, keyframe)
    assert update.landmark_ids.tolist() == old.tolist()
    assert pairs(update) == {(keyframe.id, i) for i in old.tolist()}
    assert update.marginalise_landmarks.tolist() == new.tolist()
    estimate = smoother.update(update)
    assert len(estimate.refused) == 0
    read_back(world, estimate)
    error = se3_log(inverse(pose_of(6)) @ keyframe.T_world_camera)
    assert np.abs(error).max() < 1e-6
    assert world.landmarks.in_graph[old].all()


def test_a_marginalised_landmark_with_new_observations_is_restored() -> None:
    """As fusing after a loop does: observations of a newer landmark go to an old one."""
    world, factor_selection, _ = windowed_world(WINDOWED)
    removed = world.replace_landmarks(np.array([COUNT + 3]), np.array([4]))
    factor_selection.remove_landmarks(removed)
    update = factor_selection.map_update(world)
    assert update.landmark_ids.tolist() == [4]
    assert pairs(update) == {(6, 4), (7, 4), (8, 4)}
    assert world.landmarks.in_graph[4]


def test_the_map_includes_marginalised_landmarks() -> None:
    world, factor_selection, _ = windowed_world(WINDOWED)
    update = factor_selection.whole_update(world)
    assert update.landmark_ids.tolist() == list(range(2 * COUNT))
    assert pairs(update) == pairs_of(world)


def test_no_window_keeps_every_landmark() -> None:
    world, _, smoother = windowed_world(FactorSelectionConfig())
    assert world.landmarks.in_graph.all()
    assert smoother.estimate().landmark_ids.tolist() == list(range(2 * COUNT))


def unsent(world: WorldMap) -> set[tuple[int, int]]:
    """(keyframe, landmark) of all observations that the graph was not told, by looking at all."""
    return {
        (k.id, int(k.landmark_ids[row]))
        for k in world.keyframes.values()
        for row in world.observed(k)[0]
        if k.landmark_ids[row] != k.sent_ids[row]
    }


def change(world: WorldMap, selector: FactorSelector, rng: np.random.Generator) -> None:
    """Something that happens to a map: keyframes gain or lose observations, landmarks go."""
    keyframe = world.keyframes[int(rng.choice(list(world.keyframes)))]
    rows, ids = world.observed(keyframe)
    some = rng.permutation(len(rows))[:5]
    match rng.integers(5):
        case 0:
            free = rng.permutation(np.flatnonzero(keyframe.free))[:8]
            new = rng.permutation(np.setdiff1d(np.flatnonzero(world.landmarks.in_map), ids))
            count = min(len(free), len(new))
            world.attach(keyframe, free[:count], new[:count])
        case 1:
            world.detach(keyframe, rows[some])
        case 2:
            pair = np.sort(rng.choice(np.flatnonzero(world.landmarks.in_map), 2, replace=False))
            selector.remove_landmarks(world.replace_landmarks(pair[1:], pair[:1]))
        case 3:
            world.landmarks.remove(ids[some[:1]])
            selector.remove_landmarks(ids[some[:1]])
        case 4:
            world.mask_landmarks(ids[some[:1]])
            selector.remove_landmarks(ids[some[:1]])


@pytest.mark.parametrize("seed", range(4))
def test_updates_send_what_a_look_at_the_whole_map_would(seed: int) -> None:
    """Landmarks are marginalised and come back; the graph refuses some of what it was sent."""
    rng, (world, points) = np.random.default_rng(seed), make_world(1, 200)
    world.detach(world.keyframes[0], np.arange(30, 200))
    rules = FactorSelectionConfig(1000, 2, 60, 0, 2, 5, 5)
    selector, returned = FactorSelector(rules), 0
    selector.keyframe_update(world, world.keyframes[0])
    for k in range(1, 60):
        for _ in range(3):
            change(world, selector, rng)
        landmarks, before = world.landmarks, unsent(world)
        if k % 3:
            features = make_features(pose_of(k), points, random_descriptors(200, rng))
            keyframe = add_keyframe(world, pose_of(k), features)
            near = np.abs(np.arange(len(landmarks)) - 3 * k) < 30
            seen = np.flatnonzero(landmarks.in_map & near & (rng.random(len(near)) < 0.5))
            world.attach(keyframe, seen, seen)
            before |= {(keyframe.id, i) for i in seen.tolist()}
            update = selector.keyframe_update(world, keyframe)
        else:
            sent = {
                i for o in world.keyframes.values() for i in o.sent_ids[o.sent_ids >= 0].tolist()
            }
            again = {i for _, i in before if i in sent and not landmarks.in_graph[i]}
            update = selector.map_update(world)
            assert set(update.landmark_ids.tolist()) == again
            returned += len(again)
        expected = {(keyframe_id, i) for keyframe_id, i in before if landmarks.in_graph[i]}
        assert pairs(update) == expected
        held = np.flatnonzero(landmarks.in_graph & landmarks.in_map)
        refused = held[rng.random(len(held)) < 0.1]
        read_back(world, estimate_of(world, np.setdiff1d(held, refused), np.eye(4)))
    assert returned > 10, returned
