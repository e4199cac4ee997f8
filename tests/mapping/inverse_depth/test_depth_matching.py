"""Step 2: costs and windows against loops, disparities and sweeps against known surfaces."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest
import torch
from surface_scene import plane_rho

from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, se3_exp
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.matching_cost import (
    GuidedFilter,
    MatchingConfig,
    matching_cost,
    winner,
)
from bmask_slam.mapping.inverse_depth.plane_sweep import (
    SweepConfig,
    _enlarged,
    fill_missing,
    shrunk_camera,
    sweep,
)
from bmask_slam.mapping.inverse_depth.stereo import left_right_consistent, match_stereo

RNG = np.random.default_rng(8)
CAMERA = Camera(96, 72, fx=90.0, fy=91.0, cx=47.0, cy=36.5, stereo_bf_px_m=9.0)
SMALL = MatchingConfig(guided_radius=2)


def texture(height: int, width: int) -> np.ndarray:
    """A smooth random picture (3, H, W), 0 to 255."""
    rough = RNG.uniform(0, 255, (height, width, 3)).astype(np.float32)
    smooth = cv2.GaussianBlur(rough, (0, 0), 1.2)
    return np.clip(128 + 3 * (smooth - 128), 0, 255).transpose(2, 0, 1).copy()


def tensor(array) -> torch.Tensor:
    return torch.tensor(np.asarray(array), dtype=torch.float32)


def test_the_cost_equals_the_formula() -> None:
    a, b = texture(7, 9), texture(7, 9)
    cost = matching_cost(tensor(a), tensor(b), SMALL).numpy()
    for v in range(7):
        for u in range(9):
            colour = min(np.mean([abs(a[c, v, u] - b[c, v, u]) for c in range(3)]), 30)
            slope = 0.0
            if 0 < u < 8:
                g = [(x[:, v, u + 1].mean() - x[:, v, u - 1].mean()) / 2 for x in (a, b)]
                slope = min(abs(g[0] - g[1]), 2)
            assert cost[v, u] == pytest.approx(0.1 * colour + 0.9 * slope, rel=1e-4, abs=1e-4)


def test_the_guided_filter_equals_loops() -> None:
    image, cost = texture(7, 9), RNG.uniform(0, 5, (7, 9))
    fast = GuidedFilter(tensor(image), SMALL)(tensor(cost)).numpy()
    guide = image.mean(axis=0) / 255

    def windows(v, u):
        return np.s_[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3]

    a, b = np.zeros((7, 9)), np.zeros((7, 9))
    for v, u in np.ndindex(7, 9):
        g, c = guide[windows(v, u)], cost[windows(v, u)]
        a[v, u] = (np.mean(g * c) - g.mean() * c.mean()) / (g.var() + SMALL.guided_epsilon)
        b[v, u] = c.mean() - a[v, u] * g.mean()
    for v, u in np.ndindex(7, 9):
        slow = a[windows(v, u)].mean() * guide[v, u] + b[windows(v, u)].mean()
        assert fast[v, u] == pytest.approx(slow, rel=1e-4, abs=1e-5)


def test_the_minimum_is_refined_by_a_parabola() -> None:
    levels = np.arange(7.0)
    costs = tensor((levels - 3.3) ** 2 + 1)[:, None, None]
    index, clear = winner(costs)
    assert float(index) == pytest.approx(3.3, abs=1e-4)
    assert float(clear) == pytest.approx((1.7**2 + 1) / (0.3**2 + 1), rel=1e-4)


def test_stereo_finds_the_disparity_with_the_right_sign() -> None:
    wide = texture(40, 90)
    disparity = np.full((40, 70), 4)
    disparity[12:28, 25:45] = 9
    right = wide[:, :, 5:75]
    v, u = np.mgrid[:40, :70]
    left = right[:, v, np.clip(u - disparity, 0, 69)]  # u_right = u_left - d
    camera = dataclasses.replace(CAMERA, width=70, height=40)
    window, config = (2 / 9.0, 12 / 9.0), MatchingConfig(guided_radius=3)
    found = match_stereo(tensor(left), tensor(right), camera, window, config)
    known = found.known.numpy()
    error = found.rho.numpy() * 9.0 - disparity
    inner = np.zeros_like(known)
    inner[4:36, 14:66] = True
    assert (known & inner).sum() > 0.75 * inner.sum()
    assert np.mean(np.abs(error[known & inner]) < 0.5) > 0.95
    np.testing.assert_allclose(found.variance.numpy()[known], (1 / 9.0) ** 2, rtol=1e-5)


def test_a_disparity_outside_the_range_gives_no_depth() -> None:
    wide = texture(40, 90)
    left, right = tensor(wide[:, :, :70]), tensor(wide[:, :, 12:82])  # u_right = u_left - 12
    camera = dataclasses.replace(CAMERA, width=70, height=40)
    config = MatchingConfig(guided_radius=3)
    found = []
    for low, high in ((9, 15), (12, 15), (2, 9)):
        window = (low / 9.0, high / 9.0)
        found.append(match_stereo(left, right, camera, window, config=config).rho[:, 16:] * 9.0)
    for disparity in found[:2]:
        assert (disparity - 12).abs().nan_to_num(9.0).lt(0.5).float().mean() > 0.9
    beyond = found[2][found[2].isfinite()]
    assert len(beyond) < 0.5 * found[2].numel()
    assert beyond.min() > 1.01 and beyond.max() < 9.99


def test_left_right_inconsistencies_are_dropped() -> None:
    left, right = tensor(np.full((1, 8), 2.0)), tensor(np.full((1, 8), 2.0))
    right[0, 3] = 5.0
    np.testing.assert_array_equal(
        left_right_consistent(left, right).numpy()[0],
        [False, False, True, True, True, False, True, True],
    )


def plane_views():
    """Two views of a textured plane, their true inverse depth, and T_own_other."""
    T_a = np.eye(4)
    T_b = se3_exp(np.array([0.01, -0.02, 0.015, 0.12, -0.03, 0.02]))
    normal, offset_m = np.array([0.15, 0.1, 1.0]), 1.5
    picture = texture(400, 400).transpose(1, 2, 0)
    images = []
    for T in (T_a, T_b):
        rho = plane_rho(T, normal, offset_m, CAMERA)
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
        points = CAMERA.backproject(np.stack([u, v], -1), 1 / rho) @ T[:3, :3].T + T[:3, 3]
        at = (points[..., :2] * 60 + 200).astype(np.float32)
        images.append(cv2.remap(picture, at[..., 0], at[..., 1], cv2.INTER_LINEAR))
    a, b = (tensor(i.transpose(2, 0, 1)) for i in images)
    return a, b, plane_rho(T_a, normal, offset_m, CAMERA), inverse(T_a) @ T_b


def test_a_plane_sweep_finds_the_plane_with_a_consistent_sigma() -> None:
    a, b, truth, T_a_b = plane_views()
    found = sweep(a, [(b, T_a_b)], CAMERA, (0.4, 1.0), SweepConfig(shrink=1, levels=40))
    known = found.known.numpy()
    error = found.rho.numpy() - truth
    assert known.mean() > 0.5
    assert np.median(np.abs(error[known])) < 0.02
    sigma = np.sqrt(found.variance.numpy()[known])
    assert np.median(sigma) == pytest.approx(1 / (90 * np.hypot(0.12, 0.03)), rel=0.2)
    assert np.mean((error[known] / sigma) ** 2) < 1.5


def test_a_wrong_motion_gives_little_depth() -> None:
    a, b, _, T_a_b = plane_views()
    config = SweepConfig(shrink=1, levels=40)
    right = sweep(a, [(b, T_a_b)], CAMERA, (0.4, 1.0), config).known
    wrong = sweep(a, [(b, inverse(T_a_b))], CAMERA, (0.4, 1.0), config).known
    assert wrong.sum() < 0.3 * right.sum()


def test_a_scaled_camera_has_the_same_rays() -> None:
    small = shrunk_camera(CAMERA, 2)
    point = np.array([[0.1, -0.2, 1.5]])
    np.testing.assert_allclose(
        small.project(point), (CAMERA.project(point) + 0.5) / 2 - 0.5, atol=1e-9
    )


def test_each_pixel_has_the_estimate_of_its_block_in_odd_images_too() -> None:
    blocks = torch.arange(240.0 * 160).reshape(240, 160)
    whole = _enlarged(InverseDepthMap(blocks, blocks), (481, 321))
    expected = blocks.repeat_interleave(2, dim=0).repeat_interleave(2, dim=1)
    assert (whole.rho[:480, :320] == expected).all()
    assert (whole.rho[480, :320] == expected[479]).all() and whole.rho[480, 320] == blocks[-1, -1]


def test_measurements_are_preferred_to_the_sweep() -> None:
    half = tensor([[1.0, np.nan]])
    swept = InverseDepthMap(tensor([[3.0, 4.0]]), tensor([[0.1, 0.2]]))
    result = fill_missing(InverseDepthMap(half, half / 100), swept)
    np.testing.assert_allclose(result.rho, [[1.0, 4.0]])
    np.testing.assert_allclose(result.variance, [[0.01, 0.2]])
