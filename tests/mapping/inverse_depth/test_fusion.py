"""Step 4 against the formulas, pixel by pixel, and on known surfaces."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from surface_scene import (
    CAMERA,
    as_map,
    largest_set,
    noisy_map,
    plane_rho,
    poses,
    relative,
    weighted,
)

from bmask_slam.graph.geometry import inverse, make_pose, se3_exp, transform
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap
from bmask_slam.mapping.inverse_depth.fusion import (
    BLUR_PX,
    WRONG_SIDE,
    Fused,
    fuse,
    hole_seeds,
    rim_steps,
    variance_factor,
    with_calibrated_variance,
)
from bmask_slam.mapping.inverse_depth.pixelwise import squared_gradient
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.inverse_depth.warping import (
    JUMP_SIGMAS,
    MAX_APART_PX,
    View,
    hypothesis,
    project,
)


def read(given: InverseDepthMap, u: float, v: float, inner: bool):
    """rho and variance of a map at a pixel: between pixels if they are one surface."""
    rho, variance = (a.numpy().astype(float) for a in (given.rho, given.variance))
    height, width = rho.shape
    if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
        return np.nan, np.nan
    near = round(v), round(u)
    u0, v0 = min(int(u), width - 2), min(int(v), height - 2)
    a, b = u - u0, v - v0
    block = rho[v0 : v0 + 2, u0 : u0 + 2]
    between = np.array([1 - b, b]) @ block @ np.array([1 - a, a])
    if (between - rho[near]) ** 2 < JUMP_SIGMAS**2 * variance[near]:
        return between, variance[near]
    return (np.nan, np.nan) if inner else (rho[near], variance[near])


def neighbour_estimate(seed: float, u: int, v: int, view: View, inner: bool):
    """One neighbour's hypothesis about the point at ``seed`` on the ray of pixel (u, v)."""
    point = CAMERA.backproject(np.array([u, v], float), np.array(1 / seed))
    there = transform(inverse(view.T_own_neighbour), point[None])[0]
    if there[2] <= 0:
        return np.nan, np.nan
    pixel = CAMERA.project(there)
    rho, variance = read(view.map, *pixel, inner)
    sigma = np.sqrt(variance)
    if not rho > sigma:
        return np.nan, np.nan

    def back(r: float):
        at = CAMERA.backproject(pixel, np.array(1 / r))
        return transform(view.T_own_neighbour, at[None])[0]

    middle = back(rho)
    if middle[2] <= 0 or np.linalg.norm(CAMERA.project(middle) - (u, v)) >= MAX_APART_PX:
        return np.nan, np.nan
    p1, p2, p3 = (1 / back(r)[2] for r in (rho + sigma, rho, rho - sigma))
    return p2, max(abs(p1 - p2), abs(p3 - p2)) ** 2


def reference(own: InverseDepthMap, views: list[View], seeds):
    """Step 4 by its formulas, without colours."""
    rho0, variance0 = (a.numpy().astype(float) for a in (own.rho, own.variance))
    out = np.full((3, *rho0.shape), np.nan)
    for v, u in np.ndindex(*rho0.shape):
        known = np.isfinite(rho0[v, u])
        seed = rho0[v, u] if known else seeds[v, u]
        if not np.isfinite(seed):
            continue
        estimates = [neighbour_estimate(seed, u, v, view, not known) for view in views]
        r, s = (
            [rho0[v, u], *(m for m, _ in estimates)],
            [variance0[v, u], *(x for _, x in estimates)],
        )
        chosen = largest_set(r, s)
        if not chosen and known and not any(m < seed for m, _ in estimates):
            chosen = [0]
        if chosen:
            total = sum(1 / s[k] for k in chosen)
            out[:, v, u] = weighted(r, s, chosen), 1 / total, len(chosen)
    return out


def scene(seed: int, count: int):
    rng = np.random.default_rng(seed)
    T = poses(rng, count)
    maps = [noisy_map(rng, pose) for pose in T]
    return maps[0], [View(m, relative(T[0], t)) for m, t in zip(maps[1:], T[1:], strict=True)]


@pytest.mark.parametrize("count", [1, 2, 4, 7])
def test_the_result_equals_the_formulas(count: int) -> None:
    own, views = scene(count, count)
    result = fuse(own, views, CAMERA)
    rho, variance, used = reference(own, views, hole_seeds(own, views, CAMERA).numpy())
    np.testing.assert_allclose(result.map.rho.numpy(), rho, rtol=1e-5)
    np.testing.assert_allclose(result.map.variance.numpy(), variance, rtol=1e-5)
    np.testing.assert_array_equal(result.views.numpy(), np.nan_to_num(used))
    if count == 7:
        assert (used >= 5).sum() > 100
        assert (np.isfinite(rho) & ~own.known.numpy()).sum() > 5


def test_a_neighbour_gives_the_inverse_depth_of_the_same_plane() -> None:
    T_a, T_b = poses(np.random.default_rng(0), 2, 0.05, 0.15)
    truth = plane_rho(T_a)
    view = View(as_map(plane_rho(T_b), 0.01), relative(T_a, T_b))
    mean, variance = hypothesis(torch.tensor(truth, dtype=torch.float32), view, CAMERA)
    valid = np.isfinite(mean.numpy())
    assert valid.mean() > 0.6
    np.testing.assert_allclose(mean.numpy()[valid], truth[valid], rtol=2e-5)
    assert (variance.numpy()[valid] > 0).all()


def test_points_behind_the_other_camera_have_no_projection() -> None:
    away = make_pose(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))
    u, v, ratio = project(torch.full((30, 40), 0.5), away, CAMERA)
    assert not (torch.isfinite(u) | torch.isfinite(v)).any()
    assert (ratio == 0).all()
    truth = np.full((30, 40), 0.5)
    view = View(as_map(truth, 0.01), away)
    assert torch.isnan(hypothesis(torch.tensor(truth).float(), view, CAMERA)[0]).all()


def test_moving_the_world_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    T = poses(rng, 3)
    moved = se3_exp(rng.normal(0, 1, 6))
    maps = [noisy_map(rng, pose) for pose in T]
    pairs = list(zip(maps[1:], T[1:], strict=True))
    a, b = (
        fuse(maps[0], [View(m, relative(P @ T[0], P @ t)) for m, t in pairs], CAMERA).map.rho
        for P in (np.eye(4), moved)
    )
    a, b = a.numpy(), b.numpy()
    assert np.mean(np.isfinite(a) != np.isfinite(b)) < 0.002
    both = np.isfinite(a) & np.isfinite(b)
    assert np.quantile(np.abs(a - b)[both], 0.998) < 1e-4


def test_independent_views_add_information() -> None:
    truth = np.full((30, 40), 0.5)
    views = [View(as_map(truth, 0.01), np.eye(4)) for _ in range(3)]
    result = fuse(as_map(truth, 0.01), views, CAMERA)
    np.testing.assert_allclose(result.map.variance.numpy(), 0.01**2 / 4, rtol=2e-2)


def test_an_estimate_in_a_neighbours_free_space_is_removed() -> None:
    own = as_map(np.full((30, 40), 0.505), 0.001)
    behind = View(as_map(np.full((30, 40), 0.5), 0.001), np.eye(4))
    before = View(as_map(np.full((30, 40), 0.51), 0.001), np.eye(4))
    assert not fuse(own, [behind], CAMERA).map.known.any()
    assert fuse(own, [before], CAMERA).map.known.all()


def test_a_hole_is_filled_where_two_neighbours_and_colours_agree() -> None:
    rho = np.full((30, 40), 0.5)
    holed = rho.copy()
    holed[10:20, 10:20] = np.nan
    grey = torch.full((3, 30, 40), 100.0)
    views = [View(as_map(rho, 0.01), np.eye(4), grey) for _ in range(2)]
    assert fuse(as_map(holed, 0.01), views, CAMERA, grey).map.known.all()
    assert not fuse(as_map(holed, 0.01), views[:1], CAMERA, grey).map.known[10:20, 10:20].any()
    other = grey.clone()
    other[:, 10:20, 10:20] = 200.0
    assert not fuse(as_map(holed, 0.01), views, CAMERA, other).map.known[10:20, 10:20].any()


def test_the_rim_of_a_nearer_surface_is_not_filled_from_behind() -> None:
    rho = np.full((30, 40), 0.5)
    own = rho.copy()
    own[:, :10], own[:, 10:12] = 1.0, np.nan
    views = [View(as_map(rho, 0.01), np.eye(4)) for _ in range(2)]
    assert np.isnan(hole_seeds(as_map(own, 0.01), views, CAMERA).numpy()[:, 10:12]).all()


def test_the_rim_of_a_seeded_surface_is_not_seeded_from_behind() -> None:
    near, far = np.full((30, 40), np.nan), np.full((30, 40), 0.5)
    near[:, 10:20], far[:, 10:20] = 1.0, np.nan
    empty = as_map(np.full((30, 40), np.nan), 0.01)
    views = [View(as_map(rho, 0.01), np.eye(4)) for rho in (near, far)]
    found = hole_seeds(empty, views, CAMERA).numpy()
    np.testing.assert_array_equal(found[:, 10:20], 1.0)
    assert np.isnan(found[:, [8, 9, 20, 21]]).all()
    np.testing.assert_array_equal(found[:, :8], 0.5)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_the_factor_corrects_wrong_variances(scale: float) -> None:
    rng = np.random.default_rng(1)
    maps = [as_map(0.5 + rng.normal(0, 0.004, (200, 200)), 0.004 / scale) for _ in range(4)]
    estimates = [(m.rho, m.variance) for m in maps[1:]]
    assert variance_factor(maps[0], estimates) == pytest.approx(scale**2, rel=0.1)


def test_no_neighbours_give_no_factor() -> None:
    assert variance_factor(as_map(np.full((30, 40), 0.5), 0.01), []) == 1.0


def unchanged(given: InverseDepthMap, factor: float) -> Fused:
    """Step 4 of a map that Step 5 does not change."""
    return Fused(given, given.known.to(torch.uint8), factor)


def test_the_calibrated_variance_grows_with_the_slope() -> None:
    rho = np.tile(np.linspace(0.4, 0.8, 40), (30, 1))
    given = as_map(rho, 0.002)
    slope = squared_gradient(given.rho).numpy()[:, 1:-1]
    np.testing.assert_allclose(slope, (0.4 / 39) ** 2, rtol=1e-3)
    stated_variance = with_calibrated_variance(given, unchanged(given, 0.5)).variance
    extra = (stated_variance - 0.5 * given.variance).numpy()[:, 1:-1]
    np.testing.assert_allclose(extra, BLUR_PX**2 * slope, rtol=1e-3)


def test_the_calibrated_variance_decreases_with_smoothing() -> None:
    rng = np.random.default_rng(4)
    given = as_map(0.5 + rng.normal(0, 0.004, (200, 200)), 0.004)
    final = regularise(given)
    stated = float(with_calibrated_variance(final, unchanged(given, 1.0)).variance.nanmedian())
    smoothed = float((final.rho - 0.5).square().nanmedian() / 0.455)
    slope = BLUR_PX**2 * float(squared_gradient(final.rho).nanmedian())
    assert smoothed < stated - slope < 0.8 * 0.004**2


def test_an_edge_pixel_may_belong_to_either_surface() -> None:
    rho = np.full((30, 40), 0.5)
    rho[:, :20], rho[:, 20] = 1.0, np.nan
    rho[4, 5] = np.nan
    given = as_map(rho, 0.01)
    rows, columns, steps = (a.numpy() for a in rim_steps(given))
    near = [
        (r, c)
        for r, c in np.argwhere(np.isfinite(rho)).tolist()
        if np.isnan(rho[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]).any()
    ]
    assert set(map(tuple, near)) == set(zip(rows.tolist(), columns.tolist(), strict=True))
    np.testing.assert_allclose(steps[(columns == 19) | (columns == 21)], 0.5)
    np.testing.assert_allclose(steps[columns < 10], 0.0)
    added = (
        with_calibrated_variance(given, unchanged(given, 1.0)).variance - given.variance
    ).numpy()
    np.testing.assert_allclose(added[:, 19], WRONG_SIDE * 0.25, rtol=1e-4)
    np.testing.assert_allclose(added[:, 10], 0, atol=1e-9)


def test_a_neighbours_surface_does_not_grow_beyond_its_edge() -> None:
    T_own_other = make_pose(np.eye(3), np.array([0.4 / 38, 0.0, 0.0]))
    rho = np.full((30, 40), np.nan)
    rho[:, :20] = 1.0
    view = View(as_map(rho, 0.01), T_own_other)
    empty = as_map(np.full((30, 40), np.nan), 0.01)
    known = fuse(empty, [view, view], CAMERA).map.known.numpy()
    assert known[:, 2:19].all()
    assert not known[:, 20:].any()
