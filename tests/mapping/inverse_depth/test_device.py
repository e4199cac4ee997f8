"""The Steps on another device than the processor: every tensor is made there and stays there.

A stand-in takes the place of a GPU. It computes on the processor but refuses, as torch does, to
bring tensors of two devices together or to give numpy one that is not the processor's.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from surface_scene import plane_rho, poses
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from bmask_slam.graph.camera import Camera
from bmask_slam.mapping.inverse_depth.dense_mapper import (
    DenseConfig,
    DenseKeyframe,
    DenseMapper,
    DepthSource,
    FusedKeyframe,
)
from bmask_slam.mapping.products.submaps import make_submap

AWAY = "meta"
"""The one device that torch can name wherever it runs; nothing would be computed on it."""
CAMERA = Camera(64, 48, fx=60.0, fy=61.0, cx=31.0, cy=24.5, stereo_bf_px_m=6.0)


class Elsewhere(torch.Tensor):
    """A tensor that is on `AWAY` for torch, and whose ``values`` are on the processor."""

    values: torch.Tensor

    @staticmethod
    def __new__(cls, values):
        layout = {"strides": values.stride(), "storage_offset": values.storage_offset()}
        made = torch.Tensor._make_wrapper_subclass(
            cls, values.shape, dtype=values.dtype, device=AWAY, **layout
        )
        made.values = values
        return made

    @classmethod
    def __torch_dispatch__(cls, function, types, arguments=(), options=None):
        return computed(function, arguments, options or {})


class StandIn(TorchDispatchMode):
    """While it is entered, what is made on `AWAY` is an `Elsewhere`."""

    def __torch_dispatch__(self, function, types, arguments=(), options=None):
        return computed(function, arguments, options or {})


class FromLists(TorchFunctionMode):
    """`torch.tensor` by way of the processor, since it does not ask the other mode."""

    def __torch_function__(self, function, types, arguments=(), options=None):
        options = options or {}
        device = options.pop("device", None) if function is torch.tensor else None
        made = function(*arguments, **options)
        return made if device is None else made.to(device)


def computed(function, arguments, options):
    """What torch would give: a tensor is where those that it is made of are, or where asked for."""
    given = [x for x in tree_leaves((arguments, options)) if isinstance(x, torch.Tensor)]
    away = [x for x in given if isinstance(x, Elsewhere)]
    if away and any(x.dim() for x in given if not isinstance(x, Elsewhere)):
        raise RuntimeError(f"{function}: tensors on {AWAY} and on the processor")
    device = options.get("device")
    there = bool(away) if device is None else device.type == AWAY
    if device is not None:
        options = options | {"device": torch.device("cpu")}
    owners = {id(x.values): x for x in away}
    arguments, options = tree_map(
        lambda x: x.values if isinstance(x, Elsewhere) else x, (arguments, options)
    )
    result = function(*arguments, **options)

    def placed(x):
        if not there or not isinstance(x, torch.Tensor):
            return x
        return owners[id(x)] if id(x) in owners else Elsewhere(x)

    return tree_map(placed, result)


def keyframes(count: int) -> list[DenseKeyframe]:
    """Keyframes of a textured plane with a right image each, and holes in their depth."""
    rng = np.random.default_rng(3)
    texture = rng.uniform(0, 255, (48, 80, 3)).astype(np.uint8)
    left, right = texture[:, :64], texture[:, 3:67]
    found = []
    for k, T in enumerate(poses(rng, count)):
        depth_m = (1 / plane_rho(T, camera=CAMERA)).astype(np.float32)
        depth_m += rng.normal(0, 0.004, depth_m.shape).astype(np.float32)
        depth_m[20:26, 28:36] = np.nan
        ids = np.arange(k, k + 10)
        plain = DenseKeyframe(k, T, left.copy(), depth_m, ids, np.linspace(1.5, 2.5, 10))
        found.append(replace(plain, right=right.copy() if k % 2 else None))
    return found


def fused(source: DepthSource, device: str) -> list[FusedKeyframe]:
    mapper = DenseMapper(CAMERA, DenseConfig(source=source, device=device))
    return [r for k in keyframes(3) for r in mapper.add(k)] + mapper.flush()


@pytest.mark.parametrize("source", get_args(DepthSource))
def test_all_steps_run_on_the_chosen_device(source: DepthSource) -> None:
    with StandIn(), FromLists():
        away = fused(source, AWAY)
        assert {type(r.map.rho) for r in away} == {Elsewhere}
        submaps = [make_submap(r, CAMERA) for r in away]
        depths = [r.map.depth_m() for r in away]
    here = fused(source, "cpu")
    for depth_m, submap, expected in zip(depths, submaps, here, strict=True):
        np.testing.assert_array_equal(depth_m, expected.map.depth_m())
        np.testing.assert_array_equal(submap.points, make_submap(expected, CAMERA).points)
    assert sum(len(s) for s in submaps) > 100


def test_the_fake_device_rejects_mixed_devices() -> None:
    with StandIn():
        away, here = torch.arange(4.0, device=AWAY), torch.arange(4.0)
        assert (2 * away).cpu().tolist() == [0, 2, 4, 6]
        with pytest.raises(RuntimeError, match="and on the processor"):
            away + here
        with pytest.raises((RuntimeError, TypeError)):
            away.numpy()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU: the stand-in must do")
def test_gpu_and_cpu_give_the_same_result() -> None:
    for source in get_args(DepthSource):
        for found, expected in zip(fused(source, "cuda"), fused(source, "cpu"), strict=True):
            same = np.isclose(found.map.depth_m(), expected.map.depth_m(), 1e-4, equal_nan=True)
            assert same.mean() > 0.99  # a threshold may fall the other way
