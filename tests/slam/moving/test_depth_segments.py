"""A card before a wall and a floor, partly in former free space."""

from __future__ import annotations

import numpy as np
import pytest

from bmask_slam.moving.depth_segments import DepthSegmentConfig, depth_segments

CONFIG = DepthSegmentConfig(step_px=8, least=3, share=0.2)


def scene() -> np.ndarray:
    """Depth in m: a wall at 4, a card at 2 that touches a floor in front."""
    depth_m = np.full((240, 320), 4.0, np.float32)
    depth_m[120:] = (4.0 * 120 / np.arange(120, 240))[:, None]
    depth_m[40:216, 80:160] = 2.0
    depth_m[:, 300:] = np.nan
    return depth_m


def free_in(rows: slice, columns: slice) -> np.ndarray:
    """Point motions of the samples: free space in a part of the image, a surface elsewhere."""
    point_motions = np.ones((240, 320), np.int8)
    point_motions[rows, columns] = -1
    return point_motions[::8, ::8]


def test_a_whole_segment_moves_if_a_part_does_and_the_floor_does_not() -> None:
    regions = depth_segments(scene(), CONFIG)
    moving = regions.moving(free_in(slice(40, 216), slice(80, 104)))
    expected = np.zeros((240, 320), bool)
    expected[40:210, 80:160] = True
    assert np.array_equal(moving[:, :38], expected[::8, ::8][:, :38])
    assert not moving[:, 38:].any()


@pytest.mark.parametrize(
    ("rows", "columns"),
    [
        (slice(40, 56), slice(80, 88)),  # too few
        (slice(40, 216), slice(80, 88)),  # too small a share
        (slice(0, 120), slice(160, 300)),  # part of a region that fills half the image
        (slice(0, 240), slice(300, 320)),  # where there is no depth
    ],
)
def test_little_evidence_moves_nothing(rows: slice, columns: slice) -> None:
    config = DepthSegmentConfig(step_px=8, least=3, share=0.2, largest=0.4)
    assert not depth_segments(scene(), config).moving(free_in(rows, columns)).any()


def test_keypoints_belong_to_the_segment_of_their_depth() -> None:
    regions = depth_segments(scene(), CONFIG)
    moving = regions.moving(free_in(slice(40, 216), slice(80, 104)))
    pixels = np.array([[120, 100], [163, 100], [163, 100], [163, 100], [200, 100], [75, 60.0]])
    depth_m = np.array([2.0, 4.0, 2.0, np.nan, np.nan, 2.05])
    found = regions.space(moving).on(pixels, depth_m)
    assert found.tolist() == [True, False, True, True, False, True]


@pytest.mark.parametrize("step", [2, 4])
def test_coverage_of_sampled_pixels_equals_that_of_keypoints(step: int) -> None:
    regions = depth_segments(scene(), CONFIG)
    space = regions.space(regions.moving(free_in(slice(40, 216), slice(80, 104))))
    few = scene()[::step, ::step]
    rows, columns = np.indices(few.shape)
    pixels = step * np.stack([columns.ravel(), rows.ravel()], axis=1).astype(float)
    slow = space.on(pixels, few.ravel().astype(float)).reshape(few.shape)
    np.testing.assert_array_equal(space.covers(few, step), slow)
    assert slow[48 // step : 208 // step, 80 // step : 160 // step].all()
    assert not slow[: 24 // step].any()


def loaded(box_m: float = 1.9) -> np.ndarray:
    """The scene, and beside the card a box with a slanted side, 8 % deeper every 8 pixels."""
    depth_m = scene()
    depth_m[80:160, 160:224] = box_m * 1.08 ** (np.arange(64) // 8)
    return depth_m


def carried_by(depth_m: np.ndarray, observed: np.ndarray, **config: float) -> np.ndarray:
    """Samples that the card carries if views observed the samples ``seen`` (30, 40) only."""
    regions = depth_segments(depth_m, DepthSegmentConfig(step_px=8, **config))  # type: ignore[arg-type]
    return regions.carried(CARD, observed.astype(np.int8))


BOX, CARD = np.zeros((2, 240, 320), bool)
CARD[40:216, 80:160] = True
BOX[80:160, 160:224] = True
BOX, CARD = BOX[::8, ::8], CARD[::8, ::8]
ROOM = ~BOX & ~CARD


def test_unobserved_segments_touching_a_moving_one_are_carried() -> None:
    np.testing.assert_array_equal(carried_by(loaded(), ROOM), BOX)


def test_static_segments_are_not_carried() -> None:
    assert not carried_by(loaded(), ROOM | BOX).any()
    lower = BOX.copy()
    lower[:15] = False
    np.testing.assert_array_equal(carried_by(loaded(), ROOM | lower), BOX & ~lower)


def test_a_large_unobserved_segment_is_not_carried() -> None:
    assert not carried_by(loaded(), np.zeros((30, 40))).any()


@pytest.mark.parametrize(
    ("box_m", "config"),
    [
        (2.6, {}),  # far behind the card
        (1.9, {"load": 0.1}),  # too much for who holds it
        (1.9, {"held_jump": 0.05}),  # in pieces
        (1.9, {"largest": 0.15}),  # no single thing any more
    ],
)
def test_not_all_segments_are_carried(box_m: float, config: dict[str, float]) -> None:
    assert carried_by(loaded(box_m), ROOM, **config).sum() < 0.15 * BOX.sum()


def test_regions_equal_a_flood_fill() -> None:
    rng = np.random.default_rng(3)
    depth_m = rng.choice([1.0, 1.02, 1.5, np.nan], (30, 40)).astype(np.float32)
    regions = depth_segments(depth_m, DepthSegmentConfig(step_px=1, jump=0.03))
    labels = regions.labels
    assert np.array_equal(labels > 0, np.isfinite(depth_m))
    for (i, j), d in np.ndenumerate(depth_m):
        for k, m in ((i + 1, j), (i, j + 1)):
            if k < 30 and m < 40 and np.isfinite(d) and np.isfinite(depth_m[k, m]):
                linked = abs(d - depth_m[k, m]) < 0.03
                assert not linked or labels[i, j] == labels[k, m]
    for label in range(1, labels.max() + 1):
        assert reached(labels == label, depth_m) == (labels == label).sum()


def reached(region: np.ndarray, depth_m: np.ndarray) -> int:
    """The number of pixels connected with a region's first one by steps below the jump."""
    todo, visited = [tuple(np.argwhere(region)[0])], set()
    while todo:
        i, j = todo.pop()
        if (i, j) in visited:
            continue
        visited.add((i, j))
        for k, m in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            inside = 0 <= k < region.shape[0] and 0 <= m < region.shape[1]
            if inside and region[k, m] and abs(depth_m[i, j] - depth_m[k, m]) < 0.03 * 1.5:
                todo.append((k, m))
    return len(visited)


@pytest.mark.parametrize(
    "bad",
    [
        {"step_px": 0},
        {"jump": 0.0},
        {"share": 0.0},
        {"largest": 2.0},
        {"held_jump": 0.0},
        {"load": -1.0},
    ],
)
def test_bad_configuration_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        DepthSegmentConfig(**bad)  # type: ignore[arg-type]
