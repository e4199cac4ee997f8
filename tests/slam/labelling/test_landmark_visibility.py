"""Landmarks that are visible in a keyframe without a match."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from synthetic_view import CAMERA

from bmask_slam.graph.geometry import inverse, se3_exp, transform
from bmask_slam.labelling.landmark_visibility import VisibleLandmarks

POSE = se3_exp(np.array([0.1, -0.3, 0.05, 0.4, -0.2, 0.3]))


def world(points_world: np.ndarray) -> Any:
    """A map with landmarks of keyframe 4 in segment 2, except the last two (removed, other)."""
    count = len(points_world)
    in_map, host = np.ones(count, bool), np.full(count, 4)
    in_map[-2], host[-1] = False, 7
    keyframe = SimpleNamespace(id=4)
    landmarks = SimpleNamespace(points_world=points_world, in_map=in_map, host=host)
    in_segment = {2: [keyframe]}.get
    return SimpleNamespace(landmarks=landmarks, in_segment=in_segment)


@pytest.mark.parametrize("size", [(CAMERA.width, CAMERA.height), (501, 375)])
def test_landmarks_on_the_measured_surface_are_visible(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    camera = replace(CAMERA, width=size[0], height=size[1])
    local = rng.uniform([-2, -2, -3], [2, 2, 5], (600, 3))
    depth_m = rng.uniform(1.0, 4.0, size[::-1])[::2, ::2].astype(np.float32)
    depth_m[:, ::7] = np.nan
    expected = {}
    for i, (x, y, z) in enumerate(local):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        column, row = round(u), round(v)
        if z > 0.1 and 0 <= column < camera.width and 0 <= row < camera.height:
            if i % 2:  # half of them on the surface
                local[i] *= depth_m[row // 2, column // 2] * 1.01 / z
            top, left = max(row // 2 - 1, 0), max(column // 2 - 1, 0)
            around = depth_m[top : row // 2 + 2, left : column // 2 + 2]
            if (np.abs(around - local[i, 2]) < 0.02 * local[i, 2]).any():
                expected[i] = (u, v, local[i, 2])
    first = min(expected)  # was matched, two pixels off
    pixels = np.array([expected[first][:2]]) + 2.0
    matched = VisibleLandmarks(pixels, local[[first], 2], np.array([first]), POSE, 2)
    found = matched.with_visible(depth_m, camera, world(transform(POSE, local)))
    others = sorted(set(expected) - {first, 598, 599})
    assert len(others) > 50
    assert found.landmark_ids.tolist() == [first, *others]
    assert np.allclose(found.pixels, [pixels[0], *(expected[i][:2] for i in others)])
    assert np.allclose(
        found.z_m, transform(inverse(POSE), transform(POSE, local))[[first, *others], 2]
    )
