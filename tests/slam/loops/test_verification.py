"""Loops of exact synthetic keyframes: pose, frames, covariance, landmarks, and rejections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2
from synthetic_view import (
    CAMERA,
    T_NEW_OLD,
    add_keyframe,
    make_features,
    points_before,
    random_descriptors,
)

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import inverse, se3_exp, se3_log, transform
from bmask_slam.loops.verification import (
    LoopConfig,
    LoopConstraint,
    LoopView,
    NoLoop,
    NoLoopReason,
    align_triples,
    loop_view,
    verify_loop,
)
from bmask_slam.world.world_map import WorldMap

T_WORLD_A = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -0.5]))
T_A_B = se3_exp(np.array([0.06, -0.09, 0.25, 0.15, -0.1, 0.2]))
T_WORLD_B = T_WORLD_A @ T_A_B
SIGMAS = np.array([0.7, 0.7, 0.12])


def views(
    seed: int,
    count: int = 200,
    outliers: float = 0.0,
    noise: float = 1.0,
    T_new_old: Array | None = None,
) -> tuple[LoopView, LoopView]:
    """Two keyframes of one place with noisy measurements each.

    A share of b's keypoints, ``outliers``, lies elsewhere with the right descriptor.
    """
    rng = np.random.default_rng(seed)
    T_new_old = np.eye(4) if T_new_old is None else T_new_old
    points = points_before(T_WORLD_B, count, rng)
    descriptors = random_descriptors(count, rng)
    other_points = points_before(T_WORLD_B, count, rng)
    points_b = np.where((np.arange(count) < outliers * count)[:, None], other_points, points)
    made = []
    for k, (T, observed) in enumerate(((T_WORLD_A, points), (T_WORLD_B, points_b))):
        error = noise * SIGMAS * rng.normal(size=(count, 3))
        T_moved, moved = T_new_old @ T, transform(T_new_old, observed)
        features = make_features(T_moved, moved, descriptors, error)
        features = replace(features, angles_rad=np.full(count, 0.25 * k))
        ids = np.arange(count) + 1000 * k
        own = CAMERA.backproject(features.pixels, features.depth_m)
        made.append(LoopView(k + 7, features, own, ids))
    return made[0], made[1]


def loop(view_a: LoopView, view_b: LoopView, config: LoopConfig | None = None) -> LoopConstraint:
    result = verify_loop(view_a, view_b, CAMERA, config)
    assert isinstance(result, LoopConstraint), result
    return result


def refusal(view_a: LoopView, view_b: LoopView, config: LoopConfig | None = None) -> NoLoop:
    result = verify_loop(view_a, view_b, CAMERA, config)
    assert isinstance(result, NoLoop), result
    return result


def without_points(view: LoopView, rows: slice) -> LoopView:
    points = view.points_camera.copy()
    points[rows] = np.nan
    return replace(view, points_camera=points)


def test_triples_are_aligned_from_b_to_a() -> None:
    rng = np.random.default_rng(1)
    T_a_b = se3_exp(rng.normal(size=(50, 6)))
    points_b = rng.normal(size=(50, 3, 3))
    found = align_triples(transform(T_a_b, points_b), points_b)
    np.testing.assert_allclose(found, T_a_b, atol=1e-7)


def test_noisy_mirrored_points_give_a_rotation() -> None:
    points_b = np.random.default_rng(2).normal(size=(20, 5, 3))
    found = align_triples(points_b * [1, 1, -1], points_b)
    np.testing.assert_allclose(np.linalg.det(found[:, :3, :3]), 1.0)


def test_exact_landmarks_give_the_exact_loop() -> None:
    result = loop(*views(0, noise=0.0))
    np.testing.assert_allclose(result.T_a_b, T_A_B, atol=1e-6)
    assert (result.keyframe_a, result.keyframe_b) == (7, 8)
    assert result.noise_scale == 1.0
    assert result.inliers >= 190


def test_exchanging_the_keyframes_inverts_the_loop() -> None:
    view_a, view_b = views(1)
    there, back = loop(view_a, view_b), loop(view_b, view_a)
    error = se3_log(there.T_a_b @ back.T_a_b)
    assert error @ np.linalg.solve(there.covariance, error) < 0.05
    # covariance at a from that at b: Ad C Ad^T, here by carrying tangents over one by one
    steps = 1e-6 * np.eye(6)
    adjoint = np.array([se3_log(T_A_B @ se3_exp(x) @ inverse(T_A_B)) / 1e-6 for x in steps]).T
    expected = adjoint @ there.covariance @ adjoint.T
    np.testing.assert_allclose(np.diag(back.covariance), np.diag(expected), rtol=0.1)


@pytest.mark.parametrize("outliers", [0.3, 0.6])
def test_outliers_with_matching_descriptors_are_rejected(outliers: float) -> None:
    result = loop(*views(2, count=300, outliers=outliers))
    error = se3_log(inverse(T_A_B) @ result.T_a_b)
    assert error @ np.linalg.solve(result.covariance, error) < chi2.ppf(0.999, 6)
    wrong = result.landmark_pairs[:, 0] < outliers * 300
    assert wrong.sum() <= 2
    assert result.inliers > 0.85 * (1 - outliers) * 300


def test_landmark_pairs_have_ids_of_a_then_b() -> None:
    pairs = loop(*views(3)).landmark_pairs
    np.testing.assert_array_equal(pairs[:, 1] - pairs[:, 0], 1000)
    view_a, view_b = views(3)
    fused = replace(view_b, landmark_ids=np.where(np.arange(200) < 150, np.arange(200), -1))
    assert len(loop(view_a, fused).landmark_pairs) == 0  # the same landmark, or none


@pytest.mark.parametrize("points_in", ["both", "half"])
def test_the_covariance_is_consistent(points_in: str) -> None:
    """NEES with 6 degrees of freedom a run. Matches in both directions must not count twice."""
    nees = []
    for seed in range(60):
        view_a, view_b = views(seed, count=120)
        if points_in == "half":  # a few points both ways, the others each way alone
            view_a = without_points(view_a, slice(0, 40))
            view_b = without_points(view_b, slice(80, 120))
        result = loop(view_a, view_b)
        error = se3_log(inverse(T_A_B) @ result.T_a_b)
        nees.append(error @ np.linalg.solve(result.covariance, error))
    low, high = chi2.ppf([0.005, 0.995], 6 * len(nees)) / len(nees)
    assert 0.9 * low < np.mean(nees) < high  # the noise scale is never below 1


def test_more_noise_than_stated_raises_the_covariance() -> None:
    quiet, loud = loop(*views(4)), loop(*views(4, noise=2.0))
    assert loud.noise_scale == pytest.approx(2.0, rel=0.15)
    ratio = np.diag(loud.covariance) / np.diag(quiet.covariance)
    assert ratio == pytest.approx(4.0, rel=0.5)


def test_moving_the_world_changes_nothing() -> None:
    plain, moved = loop(*views(5)), loop(*views(5, T_new_old=T_NEW_OLD))
    np.testing.assert_allclose(moved.T_a_b, plain.T_a_b, atol=1e-8)
    np.testing.assert_allclose(moved.covariance, plain.covariance, rtol=1e-5)


def test_the_same_call_gives_the_same_bytes() -> None:
    first, second = (loop(*views(6, outliers=0.5)) for _ in range(2))
    assert first.T_a_b.tobytes() == second.T_a_b.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_keypoints_without_landmarks_are_found_by_the_pose() -> None:
    """100 points match; the others have a point on one side only."""
    view_a, view_b = views(7)
    both = loop(without_points(view_a, slice(0, 50)), without_points(view_b, slice(150, 200)))
    assert both.inliers > 170


def test_a_view_holds_current_landmarks_with_depth_in_the_camera_frame() -> None:
    rng = np.random.default_rng(8)
    world, points = WorldMap(), points_before(T_WORLD_A, 6, rng)
    features = make_features(T_WORLD_A, points, random_descriptors(6, rng))
    features.disparity_px[1] = np.nan
    keyframe = add_keyframe(world, T_WORLD_A, features)
    ids = world.make_landmarks(keyframe, np.arange(5), points[:5])
    world.landmarks.remove(ids[2:3])
    view = loop_view(keyframe, world)
    assert view.landmark_ids.tolist() == [ids[0], ids[1], -1, ids[3], ids[4], -1]
    assert np.isfinite(view.points_camera[:, 2]).tolist() == [True, False, False, True, True, False]
    pixels = CAMERA.project(view.points_camera[[0, 3, 4]])
    np.testing.assert_allclose(pixels, features.pixels[[0, 3, 4]], atol=1e-9)


def test_another_place_has_no_matches() -> None:
    view_a, view_b = views(9)[0], views(10)[1]
    assert refusal(view_a, view_b).reason is NoLoopReason.FEW_MATCHES
    nothing = without_points(view_a, slice(None))
    assert refusal(nothing, view_b).reason is NoLoopReason.FEW_MATCHES


def test_equal_descriptors_at_other_positions_give_no_consensus() -> None:
    found = refusal(*views(11, outliers=1.0))
    assert found.reason is NoLoopReason.NO_CONSENSUS
    assert found.value < found.limit


def test_a_small_common_object_is_refused() -> None:
    """20 of 200 keypoints agree, as with the same poster in two rooms."""
    assert refusal(*views(12, outliers=0.9)).reason is NoLoopReason.FEW_INLIERS
    view_a, view_b = views(12, count=600, outliers=0.9)
    other = random_descriptors(540, np.random.default_rng(0))
    descriptors = np.concatenate([other, view_b.features.descriptors[540:]])
    view_b = replace(view_b, features=replace(view_b.features, descriptors=descriptors))
    found = refusal(view_a, view_b, LoopConfig(min_share=0.2))
    assert found.reason is NoLoopReason.LITTLE_SHARED
    assert found.value == pytest.approx(0.1, abs=0.03)


def test_an_uncertain_pose_is_refused() -> None:
    found = refusal(*views(13), LoopConfig(max_sigma_m=1e-4))
    assert found.reason is NoLoopReason.UNCERTAIN
    assert found.value > 1
