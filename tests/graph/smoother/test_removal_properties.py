"""Random graphs and random removals: no error, and nothing else changes."""

from __future__ import annotations

import dataclasses

import numpy as np
from graph_checks import assert_isam_matches_tables, filled, pairs_of
from hypothesis import given, settings
from hypothesis import strategies as st
from synthetic_room import Room, make_room

from bmask_slam.graph.factors.graph_estimate import GraphEstimate
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.factors.smoother_config import SmootherConfig
from bmask_slam.graph.geometry import inverse, se3_log
from bmask_slam.graph.smoother.anchoring import loose_in
from bmask_slam.graph.smoother.smoother import Smoother

FEW = settings(max_examples=20, deadline=None, derandomize=True)
SEEDS = st.integers(0, 10_000)
KINDS = st.sampled_from(["landmarks", "keyframes", "observations", "mask"])


def random_room(seed: int) -> Room:
    """A path with each landmark observed by a few keyframes only, many without depth."""
    rng = np.random.default_rng(seed)
    room = make_room(
        keyframes=int(rng.integers(5, 10)),
        points=int(rng.integers(30, 70)),
        noise_px=0.3,
        mono_share=float(rng.choice([0.0, 0.5, 0.9])),
        seed=seed,
    )
    observed, reach = room.observations, rng.integers(1, 4)
    home = rng.integers(0, 10, len(room.points_world))[observed.landmark_ids]
    return dataclasses.replace(
        room, observations=observed.select(np.abs(home - observed.keyframe_ids) <= reach)
    )


def random_removal(smoother: Smoother, kind: str, seed: int) -> GraphUpdate:
    """A removal of up to a third of the graph, or of nearly all observations of a keyframe."""
    rng, estimate = np.random.default_rng(seed), smoother.estimate()
    pairs = np.array(sorted(pairs_of(smoother)), np.int64).reshape(-1, 2)
    if kind == "landmarks":
        return GraphUpdate(remove_landmarks=some(rng, estimate.landmark_ids, 3))
    if kind == "keyframes":
        return GraphUpdate(remove_keyframes=some(rng, estimate.keyframe_ids[1:], 3))
    if kind == "observations":
        return GraphUpdate(remove_observations=some(rng, pairs, 3))
    own_pairs = pairs[pairs[:, 0] == rng.choice(estimate.keyframe_ids)]
    return GraphUpdate(remove_observations=own_pairs[rng.random(len(own_pairs)) < 0.9])


def some(rng: np.random.Generator, items: np.ndarray, share: int) -> np.ndarray:
    return rng.permutation(items)[: rng.integers(1, 2 + len(items) // share)]


def requested(update: GraphUpdate, pairs: set[tuple[int, int]]) -> set[tuple[int, int]]:
    """The observations that an update's removals name, directly or by a variable."""
    landmarks, keyframes = set(update.remove_landmarks.tolist()), set(update.remove_keyframes)
    single = set(map(tuple, update.remove_observations.tolist()))
    return {(k, j) for k, j in pairs if k in keyframes or j in landmarks or (k, j) in single}


def assert_only_this_left(
    smoother: Smoother, update: GraphUpdate, before: GraphEstimate, pairs: set[tuple[int, int]]
) -> GraphEstimate:
    """Apply a removal and compare the remaining items with the request and the report."""
    after = smoother.update(update)
    assert not after.rebuilt
    assert_isam_matches_tables(smoother)
    assert len(loose_in(smoother._tables, smoother._config)) == 0  # the local test missed none
    dropped = set(after.dropped_landmarks.tolist())
    expected = requested(update, pairs)
    assert pairs_of(smoother) == {(k, j) for k, j in pairs - expected if j not in dropped}
    removed = np.union1d(update.remove_landmarks, after.dropped_landmarks)
    np.testing.assert_array_equal(after.landmark_ids, np.setdiff1d(before.landmark_ids, removed))
    kept = np.setdiff1d(before.keyframe_ids, update.remove_keyframes)
    np.testing.assert_array_equal(after.keyframe_ids, kept)
    assert dropped.issubset({j for _, j in expected})
    return after


@FEW
@given(room=SEEDS, steps=st.lists(st.tuples(KINDS, SEEDS), min_size=1, max_size=4))
def test_only_requested_or_reported_items_are_removed(
    room: int, steps: list[tuple[str, int]]
) -> None:
    smoother = filled(random_room(room))
    for kind, seed in steps:
        before, pairs = smoother.estimate(), pairs_of(smoother)
        update = random_removal(smoother, kind, seed)
        assert_only_this_left(smoother, update, before, pairs)


@FEW
@given(room=SEEDS, kind=KINDS, seed=SEEDS)
def test_removing_and_adding_again_gives_the_same_optimum(room: int, kind: str, seed: int) -> None:
    made = random_room(room)
    smoother = filled(made, SmootherConfig(min_left_observations=6))  # as for new keyframes
    before, pairs = smoother.optimise_batch(), pairs_of(smoother)
    update = random_removal(smoother, kind, seed)
    after = smoother.update(update)
    new_keyframes = np.setdiff1d(before.keyframe_ids, after.keyframe_ids)
    new_landmarks = np.setdiff1d(before.landmark_ids, after.landmark_ids)
    observations = made.observations
    lost = pairs - pairs_of(smoother)
    rows = [
        (k, j) in lost
        for k, j in zip(observations.keyframe_ids, observations.landmark_ids, strict=True)
    ]
    again = smoother.update(
        GraphUpdate(
            new_keyframes,
            made.initial_poses[new_keyframes],
            new_landmarks,
            made.initial_points[new_landmarks],
            observations.select(np.array(rows, bool)),
        )
    )
    assert not again.rebuilt
    assert pairs_of(smoother) == pairs
    assert again.factors == before.factors, "an anchor stayed"
    found = smoother.optimise_batch()
    difference = se3_log(inverse(before.poses_world_camera) @ found.poses_world_camera)
    assert np.abs(difference).max() < 1e-4
