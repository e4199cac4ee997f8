"""A card before a wall and a floor, in part where space was free."""

from __future__ import annotations

import numpy as np
import pytest

from slam.depth_regions import DepthRegionConfig, depth_regions

CONFIG = DepthRegionConfig(step_px=8, least=3, share=0.2)


def scene() -> np.ndarray:
    """Metres: a wall at 4, a card at 2 whose foot stands on a floor that comes nearer."""
    depth_m = np.full((240, 320), 4.0, np.float32)
    depth_m[120:] = (4.0 * 120 / np.arange(120, 240))[:, None]
    depth_m[40:216, 80:160] = 2.0
    depth_m[:, 300:] = np.nan
    return depth_m


def free_in(rows: slice, columns: slice) -> np.ndarray:
    """Verdicts of the samples: free space in a part of the image, a surface elsewhere."""
    verdicts = np.ones((240, 320), np.int8)
    verdicts[rows, columns] = -1
    return verdicts[::8, ::8]


def test_the_whole_card_moves_if_a_part_does_and_the_floor_stays() -> None:
    regions = depth_regions(scene(), CONFIG)
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
    config = DepthRegionConfig(step_px=8, least=3, share=0.2, largest=0.4)
    assert not depth_regions(scene(), config).moving(free_in(rows, columns)).any()


def test_keypoints_are_on_what_is_as_far_away_as_they_are() -> None:
    regions = depth_regions(scene(), CONFIG)
    moving = regions.moving(free_in(slice(40, 216), slice(80, 104)))
    pixels = np.array([[120, 100], [163, 100], [163, 100], [163, 100], [200, 100], [75, 60.0]])
    depth_m = np.array([2.0, 4.0, 2.0, np.nan, np.nan, 2.05])
    found = regions.on(moving, pixels, depth_m)
    assert found.tolist() == [True, False, True, True, False, True]


def test_regions_are_those_of_a_flood_fill() -> None:
    rng = np.random.default_rng(3)
    depth_m = rng.choice([1.0, 1.02, 1.5, np.nan], (30, 40)).astype(np.float32)
    regions = depth_regions(depth_m, DepthRegionConfig(step_px=1, jump=0.03))
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
    """How many pixels of a region its first one reaches by steps of less than the jump."""
    todo, seen = [tuple(np.argwhere(region)[0])], set()
    while todo:
        i, j = todo.pop()
        if (i, j) in seen:
            continue
        seen.add((i, j))
        for k, m in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            inside = 0 <= k < region.shape[0] and 0 <= m < region.shape[1]
            if inside and region[k, m] and abs(depth_m[i, j] - depth_m[k, m]) < 0.03 * 1.5:
                todo.append((k, m))
    return len(seen)


@pytest.mark.parametrize("bad", [{"step_px": 0}, {"jump": 0.0}, {"share": 0.0}, {"largest": 2.0}])
def test_bad_configuration_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        DepthRegionConfig(**bad)  # type: ignore[arg-type]
