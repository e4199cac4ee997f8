"""A stream of keyframes through all Steps: delay, memory, and any world frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from surface_scene import CAMERA, noisy_map, poses

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.geometry import make_pose, se3_exp
from bmask_slam.mapping.inverse_depth.dense_mapper import (
    WINDOW,
    DenseConfig,
    DenseKeyframe,
    DenseMapper,
    FusedKeyframe,
    choose_neighbours,
)

RGB = np.full((30, 40, 3), 100, np.uint8)
WALL_M = 0.5


def keyframes(count: int) -> list[DenseKeyframe]:
    """Keyframes of one plane; k shares landmarks k to k + 9 with its neighbours in order."""
    rng = np.random.default_rng(3)
    found = []
    for k, T in enumerate(poses(rng, count)):
        ids = np.arange(k, k + 10)
        depth_m = noisy_map(rng, T, missing=0.05).depth_m()
        found.append(DenseKeyframe(k, T, RGB, depth_m, ids, np.full(10, 2.0)))
    return found


def all_of(mapper: DenseMapper, given: list[DenseKeyframe]) -> list[FusedKeyframe]:
    return [r for k in given for r in mapper.add(k)] + mapper.flush()


def test_a_keyframe_is_fused_after_six_more() -> None:
    mapper, given = DenseMapper(CAMERA), keyframes(16)
    ids = [[r.keyframe.id for r in mapper.add(k)] for k in given]
    assert ids == [[]] * WINDOW + [[k] for k in range(16 - WINDOW)]
    assert len(mapper._prepared) <= 2 * WINDOW + 1
    assert [r.keyframe.id for r in mapper.flush()] == list(range(10, 16))


def test_a_skipped_keyframe_is_only_a_neighbour() -> None:
    given = keyframes(9)
    expected = {r.keyframe.id: r for r in all_of(DenseMapper(CAMERA), given)}
    mapper = DenseMapper(CAMERA)
    found = [r for k in given for r in mapper.add(k, k.id == 4)] + mapper.flush()
    assert [r.keyframe.id for r in found] == [4]
    np.testing.assert_array_equal(found[0].map.rho.numpy(), expected[4].map.rho.numpy())


def test_the_neighbours_are_those_with_most_landmarks_in_common() -> None:
    given = keyframes(12)
    chosen = choose_neighbours(given[5], [k for k in given if k.id != 5], 6)
    assert [k.id for k in chosen] == [4, 6, 3, 7, 2, 8]


def moved_by(T: Array, keyframe: DenseKeyframe) -> DenseKeyframe:
    return replace(keyframe, T_world_camera=T @ keyframe.T_world_camera)


def test_the_current_poses_are_used_for_the_fusion() -> None:
    """The first keyframes are in another world frame until they are moved, as before a loop."""
    given = keyframes(8)
    expected = all_of(DenseMapper(CAMERA), given)
    mapper = DenseMapper(CAMERA)
    away = se3_exp(np.array([0.3, -0.2, 0.5, 1.0, 2.0, -1.0]))
    for k in given[:4]:
        assert mapper.add(moved_by(away, k)) == []
    mapper.update_poses({k.id: k.T_world_camera for k in given} | {99: np.eye(4)})
    found = [r for k in given[4:] for r in mapper.add(k)] + mapper.flush()
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())
        np.testing.assert_array_equal(a.keyframe.T_world_camera, b.keyframe.T_world_camera)


def test_a_flush_starts_a_new_stream() -> None:
    mapper, given = DenseMapper(CAMERA), keyframes(6)
    first = all_of(mapper, given[:3])
    again = all_of(mapper, given[3:])
    alone = all_of(DenseMapper(CAMERA), given[3:])
    assert [r.keyframe.id for r in first + again] == list(range(6))
    for a, b in zip(again, alone, strict=True):
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())


def test_a_late_keyframe_is_used_by_its_neighbours() -> None:
    given = keyframes(9)
    expected = {r.keyframe.id: r for r in all_of(DenseMapper(CAMERA), given)}
    found = all_of(DenseMapper(CAMERA), [given[k] for k in (0, 2, 4, 1, 3, 5, 6, 8, 7)])
    assert sorted(r.keyframe.id for r in found) == list(range(9))
    for result in found[2:]:  # the first were fused before all their neighbours had come
        if result.keyframe.id > 2:
            expected_rho = expected[result.keyframe.id].map.rho.numpy()
            np.testing.assert_array_equal(result.map.rho.numpy(), expected_rho)


def test_removed_keyframes_have_no_effect() -> None:
    given = keyframes(8)
    expected = all_of(DenseMapper(CAMERA), [k for k in given if k.id not in (2, 5)])
    mapper = DenseMapper(CAMERA)
    found = [r for k in given[:6] for r in mapper.add(k)]
    mapper.remove([2, 5])
    found += [r for k in given[6:] for r in mapper.add(k)] + mapper.flush()
    for a, b in zip(found, expected, strict=True):
        assert a.keyframe.id == b.keyframe.id
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())


def test_late_labels_have_the_effect_of_early_ones() -> None:
    given = keyframes(8)
    moves, numbers = np.zeros((30, 40), bool), np.ones((30, 40), np.uint16)
    moves[5:15, 8:20] = True
    hidden = np.where(moves, np.float32(np.nan), given[3].depth_m)
    relabelled = replace(given[3], depth_m=hidden, instances=numbers, unmatched=moves)
    expected = all_of(DenseMapper(CAMERA), [relabelled if k.id == 3 else k for k in given])
    mapper = DenseMapper(CAMERA)
    found = [r for k in given[:6] for r in mapper.add(k)]
    mapper.relabel(3, numbers, moves)
    mapper.relabel(99, numbers, moves)
    found += [r for k in given[6:] for r in mapper.add(k)] + mapper.flush()
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())
    assert found[3].keyframe.instances is numbers


def test_labels_of_a_fused_keyframe_take_its_depth_from_later_ones() -> None:
    """A person whose masks came late is not given back to keyframes that hide it themselves."""
    given, none = keyframes(12), np.zeros((30, 40), np.uint16)
    moves = np.zeros((30, 40), bool)
    moves[5:15, 8:20] = True
    hidden = np.where(moves, np.float32(np.nan), given[1].depth_m)
    relabelled = replace(given[1], depth_m=hidden, instances=none, unmatched=moves)
    expected = all_of(DenseMapper(CAMERA), [relabelled if k.id == 1 else k for k in given])
    plain = all_of(DenseMapper(CAMERA), given)
    mapper = DenseMapper(CAMERA)
    found = [r for k in given[:8] for r in mapper.add(k)]
    assert [r.keyframe.id for r in found] == [0, 1]
    mapper.relabel(1, none, moves)
    found += [r for k in given[8:] for r in mapper.add(k)] + mapper.flush()
    assert not np.array_equal(plain[2].map.rho.numpy(), expected[2].map.rho.numpy(), equal_nan=True)
    for a, b in zip(found[2:], expected[2:], strict=True):
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())


def swept_keyframes(count: int) -> list[DenseKeyframe]:
    """Keyframes without depth that move along a textured wall, two pixels to the right each."""
    rough = np.random.default_rng(5).uniform(0, 255, (30, 40 + 2 * count, 3))
    wall = cv2.GaussianBlur(rough, (0, 0), 1.2).astype(np.uint8)
    found = []
    for k in range(count):
        T = make_pose(np.eye(3), np.array([2 * k * WALL_M / CAMERA.fx, 0, 0]))
        rgb, none = wall[:, 2 * k : 2 * k + 40].copy(), np.full((30, 40), np.nan, np.float32)
        depths_m = WALL_M * np.linspace(0.7, 1.4, 10)
        found.append(DenseKeyframe(k, T, rgb, none, np.arange(10), depths_m))
    return found


def test_late_labels_do_not_change_with_what_a_keyframe_is_matched() -> None:
    """Of the keyframes that came since, the last ones see the least of what it sees."""
    given, config = swept_keyframes(9), DenseConfig(source="motion")
    expected = all_of(DenseMapper(CAMERA, config), given)
    mapper = DenseMapper(CAMERA, config)
    found = [r for k in given[:6] for r in mapper.add(k)]
    mapper.relabel(1, np.zeros((30, 40), np.uint16), np.zeros((30, 40), bool))
    found += [r for k in given[6:] for r in mapper.add(k)] + mapper.flush()
    assert expected[1].map.known.float().mean() > 0.3
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a.map.rho.numpy(), b.map.rho.numpy())
