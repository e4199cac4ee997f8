"""Depth of keyframes before and after fusion against the truth, and the effect of each Step."""

from __future__ import annotations

import dataclasses
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.mapping.dense_surface import Truth
from bmask_slam.dense.keyframe_input import load_keyframe
from bmask_slam.dense.saved_map import MappedRun
from bmask_slam.graph.geometry import inverse
from bmask_slam.mapping.inverse_depth.dense_mapper import (
    DenseConfig,
    DenseKeyframe,
    choose_neighbours,
)
from bmask_slam.mapping.inverse_depth.depth_map import InverseDepthMap, from_sensor
from bmask_slam.mapping.inverse_depth.fusion import Fused, fuse, with_calibrated_variance
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.inverse_depth.warping import View

OUTLIER_M = 0.05
PATCHES = 0.2
ALL_STEPS = "Steps 3, 4, 5, honest variance"
Map = InverseDepthMap


def depth_errors(maps: list[Map], truths: list[Truth], where: list[NDArray]) -> dict[str, float]:
    """Errors over the pixels that are known, have a truth and are in ``where``."""
    errors, chi2, known = [], [], []
    for given, truth, mask in zip(maps, truths, where, strict=True):
        possible = np.isfinite(truth.depth_m) & mask
        error = given.depth_m() - truth.depth_m
        valid = possible & np.isfinite(error)
        errors.append(error[valid])
        rho, variance = given.rho.numpy()[valid], given.variance.numpy()[valid]
        chi2.append((rho - 1 / truth.depth_m[valid]) ** 2 / variance)
        known.append(valid.sum() / possible.sum())
    e, c = np.concatenate(errors), np.concatenate(chi2)
    inlier = np.abs(e) < OUTLIER_M
    return {
        "rmse_mm": 1e3 * float(np.sqrt(np.mean(e**2))),
        "rmse_inliers_mm": 1e3 * float(np.sqrt(np.mean(e[inlier] ** 2))),
        "median_mm": 1e3 * float(np.median(np.abs(e))),
        "coverage": float(np.mean(known)),
        "outlier_share": float(np.mean(~inlier)),
        "chi2": float(np.mean(c)),
        "chi2_inliers": float(np.mean(c[inlier])),
    }


class Steps:
    """The Steps on all keyframes of a run, each alone or skipped."""

    def __init__(self, run: MappedRun, config: DenseConfig, lost: float = 0.0) -> None:
        """``lost`` is a share of each keyframe's depth that the sensor does not give."""
        self.camera = run.camera
        loaded = [load_keyframe(run, k)[0] for k in run.keyframes]
        self.keyframes: list[DenseKeyframe] = [without_patches(k, lost) for k in loaded]
        self.raw = [from_sensor(k.depth_m, run.camera, config.measurement) for k in self.keyframes]
        self.images = [
            torch.from_numpy(np.ascontiguousarray(cv2.blur(k.rgb, (3, 3)).transpose(2, 0, 1)))
            for k in self.keyframes
        ]

    def fused(self, maps: list[Map], count: int = 6) -> list[Fused]:
        """Step 4 with so many neighbours."""
        return [
            fuse(maps[i], self.views(i, maps, count), self.camera, self.images[i].float())
            for i in range(len(self.keyframes))
        ]

    def views(self, i: int, maps: list[Map], count: int = 6) -> list[View]:
        """The maps of the ``i``-th keyframe's neighbours as it sees them."""
        index = {k.id: n for n, k in enumerate(self.keyframes)}
        own = self.keyframes[i]
        window = [k for k in self.keyframes[max(i - 6, 0) : i + 7] if k is not own]
        T_own_world = inverse(own.T_world_camera)
        return [
            View(
                maps[index[k.id]], T_own_world @ k.T_world_camera, self.images[index[k.id]].float()
            )
            for k in choose_neighbours(own, window, count)
        ]


def without_patches(keyframe: DenseKeyframe, lost: float) -> DenseKeyframe:
    """A keyframe without a share of its depth, lost in patches of its own, as on glossy surfaces.

    The patches are 20 to 60 pixels wide: where smooth noise is low.
    """
    if not lost:
        return keyframe
    noise = np.random.default_rng([keyframe.id, 7]).standard_normal(keyframe.depth_m.shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), 12)
    patches = smooth < np.quantile(smooth, lost)
    depth_m = np.where(patches, np.float32(np.nan), keyframe.depth_m)
    return dataclasses.replace(keyframe, depth_m=depth_m)


def patchy(run: MappedRun, truths: list[Truth], config: DenseConfig) -> dict[str, Any]:
    """Depth before and after all Steps with a sensor that loses PATCHES of every image."""
    steps = Steps(run, config, PATCHES)
    fused = steps.fused([regularise(m) for m in steps.raw])
    final = [with_calibrated_variance(regularise(f.map), f) for f in fused]
    everywhere = [np.ones(t.depth_m.shape, bool) for t in truths]
    return {
        "sensor": depth_errors(steps.raw, truths, everywhere),
        ALL_STEPS: depth_errors(final, truths, everywhere),
    }


def ablation(steps: Steps) -> dict[str, list[Map]]:
    """Maps of every keyframe after each Step, and with Steps skipped."""
    step3 = [regularise(m) for m in steps.raw]
    step4 = steps.fused(step3)
    step5 = [regularise(f.map) for f in step4]
    without3 = steps.fused(steps.raw)
    two = steps.fused(step3, 2)
    return {
        "sensor": steps.raw,
        "Step 3": step3,
        "Steps 3, 4": [f.map for f in step4],
        "Steps 3, 4, 5": step5,
        ALL_STEPS: [with_calibrated_variance(m, f) for m, f in zip(step5, step4, strict=True)],
        "without 3": [regularise(f.map) for f in without3],
        "without 4": [regularise(m) for m in step3],
        "two neighbours": [regularise(f.map) for f in two],
        "holes filled by the paper's 2": [
            regularise(f.map, 2) for f in steps.fused([regularise(m, 2) for m in steps.raw])
        ],
    }
