"""The compiled loop of the volume against the same rules in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from surface_scene import CAMERA, as_map, plane_rho, poses

from bmask_slam.graph.arrays import Floats
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping import compiled
from bmask_slam.mapping.surface import kernel
from bmask_slam.mapping.surface.blocks import BRICKS
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame
from bmask_slam.mapping.surface.pixel_planes import BEHIND, NZ, OFFSET, WEIGHT, Z
from bmask_slam.mapping.surface.volume import (
    COLOUR_VOXELS,
    FREE_SHARE,
    FRONT_VOXELS,
    SurfaceVolume,
)

VOXEL_M = 0.05


def test_halves_are_those_of_numpy() -> None:
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [rng.uniform(0, 300, 2000), 10.0 ** rng.uniform(-9, np.log10(kernel.HALF_MAX), 2000), [0]]
    ).astype(np.float32)
    bits = np.arange(31001, dtype=np.uint16)
    halves = bits.view(np.float16).astype(np.float32)
    ties = (halves[:-1:7] + halves[1::7]) / 2
    for value in np.concatenate([values, halves[::5], ties]):
        assert kernel.half_bits(value) == value.astype(np.float16).view(np.uint16), value
    assert [kernel.half_value(b) for b in bits] == halves.tolist()


def frames() -> list[DepthFrame]:
    rng = np.random.default_rng(2)
    made = []
    for T in poses(rng, 4):
        rho = plane_rho(T, np.array([0.2, -0.1, 1.0]), 2.0)
        rho[10:14, 20:26] = np.nan
        rgb = rng.integers(20, 230, (30, 40, 3), np.uint8)
        made.append(depth_frame(as_map(rho, 0.002), rgb, T, CAMERA, VOXEL_M))
    return made


def places(volume: SurfaceVolume) -> Floats:
    """Centres (8 B, 64, 3) of all voxels in the world."""
    bricks = np.arange(len(volume) * BRICKS)
    corners = volume._origin.numpy()[bricks // BRICKS] + volume._bricks.numpy()[bricks % BRICKS]
    return corners[:, None] + volume._voxels.numpy()


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (3, 1)])
def test_a_volume_holds_what_the_rules_give(order: tuple[int, ...]) -> None:
    volume, given = SurfaceVolume(VOXEL_M, CAMERA), frames()
    for k in order:  # first, so that all frames see all blocks
        volume._make_blocks(given[k])
    W, D, free = (np.zeros((len(volume) * BRICKS, 64)) for _ in range(3))
    for k in order:
        volume.integrate(given[k])
        T = inverse(given[k].T_world_camera)
        p = places(volume) @ T[:3, :3].T + T[:3, 3]
        u, v = (
            np.rint(p[..., axis] / p[..., 2] * f + c).astype(int)
            for axis, f, c in ((0, CAMERA.fx, CAMERA.cx), (1, CAMERA.fy, CAMERA.cy))
        )
        inside = (u >= 0) & (u < 40) & (v >= 0) & (v < 30) & (p[..., 2] > kernel.NEAREST_M)
        bricks = volume._seen(given[k], torch.from_numpy(T).to(torch.float32)).numpy()
        inside &= np.isin(np.arange(len(W)), bricks)[:, None]
        pixel = np.where(inside, 40 * v + u, 0)
        plane = given[k].pixels.numpy()[pixel]
        free_m = given[k].free_m.numpy()[pixel] * (1 - FREE_SHARE) - FRONT_VOXELS * VOXEL_M
        free += inside & (p[..., 2] < free_m)
        d = (plane[..., : NZ + 1] * p).sum(-1) - plane[..., OFFSET]
        used = inside & (plane[..., WEIGHT] > 0) & (d > -plane[..., BEHIND])
        used &= p[..., 2] < plane[..., Z] + 2 * plane[..., BEHIND]
        d = np.minimum(d, FRONT_VOXELS * VOXEL_M)
        fall = np.minimum((d + plane[..., BEHIND]) / (plane[..., BEHIND] - VOXEL_M + 1e-12), 1)
        w = np.where(used, plane[..., WEIGHT] * fall, 0)
        D = np.where(used, (W * D + w * d) / np.where(used, W + w, 1), D)
        W += w
    count = len(W)
    agree = [
        np.isclose(table.numpy()[:count], expected, rtol=1e-4, atol=1e-5)
        for table, expected in ((volume.weight, W), (volume.distance, D), (volume.free, free))
    ]
    assert (W > 0).sum() > 1000 < free.sum()
    assert min(table.mean() for table in agree) > 0.9999  # rounding to a pixel may differ
    seen = (np.abs(D) < (COLOUR_VOXELS - 1) * VOXEL_M) & (W > 0)
    assert (volume.witnesses.numpy()[:count][seen] > 0).mean() > 0.9


@pytest.mark.parametrize(("counted", "other"), [("witnesses", "free"), ("free", "witnesses")])
def test_shares_hold_however_many_frames_are_counted(counted: str, other: str) -> None:
    """A camera that stands for minutes: a float16 counts to 2048."""
    volume = SurfaceVolume(VOXEL_M, CAMERA)
    near, far = (
        depth_frame(
            as_map(np.full((30, 40), 1 / z_m), 0.002),
            np.full((30, 40, 3), 99, np.uint8),
            np.eye(4),
            CAMERA,
            VOXEL_M,
        )
        for z_m in (2.0, 3.0)
    )
    volume.integrate(near)
    at = volume.witnesses == 1
    often, seldom = (near, far) if counted == "witnesses" else (far, near)
    getattr(volume, counted)[at], getattr(volume, other)[at] = 2040, 408
    for _ in range(40):
        for frame in (*[often] * 5, seldom):
            volume.integrate(frame)
    counts, others = (getattr(volume, name)[at].float() for name in (counted, other))
    both = others > 210
    assert both.float().mean() > 0.5
    np.testing.assert_allclose((others / counts)[both], 0.2, rtol=0.01)


def test_where_nothing_can_be_kept_it_is_compiled_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*, cache: bool = False, nogil: bool, error_model: str) -> object:
        if cache:
            raise RuntimeError("no locator available")
        return lambda function: function

    monkeypatch.setattr(compiled.numba, "njit", refused)
    assert compiled.compiled(len) is len
