"""Time of the Steps on one keyframe, and of Open3D's TSDF."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from benchmarks.mapping.dense_depth import Map, Steps
from benchmarks.mapping.dense_surface import VOXEL_M, open3d_points
from bmask_slam.dense.saved_map import MappedRun
from bmask_slam.mapping.inverse_depth.backprojection import back_project, surface_normals
from bmask_slam.mapping.inverse_depth.dense_mapper import DenseConfig, FusedKeyframe
from bmask_slam.mapping.inverse_depth.depth_map import from_sensor
from bmask_slam.mapping.inverse_depth.fusion import Fused, fuse, with_calibrated_variance
from bmask_slam.mapping.inverse_depth.regularisation import regularise
from bmask_slam.mapping.products.submaps import make_submap

ROUNDS = 6
MAX_LOAD = 1.7
"""Of the machine with this process; above it wall times are not measured."""


def step_times_ms(steps: Steps, run: MappedRun, config: DenseConfig) -> dict[str, Any]:
    """Least times of a keyframe in the middle: Steps one by one and together, and Open3D's TSDF.

    "processor" is processor time on one thread, "wall" wall time on two, empty on a busy
    machine. They alternate ROUNDS times, since the speed of a machine varies.
    """
    load = os.getloadavg()[0]
    single = _Single(steps, run, config)
    works = single.works()
    together: dict[str, Callable[[], Any]] = {
        "all Steps": single.all_steps,
        "TSDF": lambda: open3d_points(run, steps.keyframes),
    }
    processor = dict.fromkeys([*works, *together], np.inf)
    wall = dict.fromkeys(together if load < MAX_LOAD else (), np.inf)
    threads = torch.get_num_threads()
    for _ in range(ROUNDS):
        for name, work in {**works, **together}.items():
            torch.set_num_threads(1)
            processor[name] = min(processor[name], _time_ms(work, time.process_time))
            if name in wall:
                torch.set_num_threads(2)
                wall[name] = min(wall[name], _time_ms(work, time.perf_counter))
    torch.set_num_threads(threads)
    for times in filter(None, (processor, wall)):
        times["TSDF"] /= len(steps.keyframes)
    return {"processor": processor, "wall": wall, "load": load}


def _time_ms(work: Callable[[], Any], clock: Callable[[], float]) -> float:
    started_s = clock()
    work()
    return 1e3 * (clock() - started_s)


class _Single:
    """The Steps of the keyframe in the middle, their input made."""

    def __init__(self, steps: Steps, run: MappedRun, config: DenseConfig) -> None:
        i = len(steps.keyframes) // 2
        self._own, self._camera = steps.keyframes[i], run.camera
        self._measurement = config.measurement
        self._image = steps.images[i].float()
        self._views = steps.views(i, [regularise(m) for m in steps.raw])

    def works(self) -> dict[str, Callable[[], Any]]:
        """Each Step alone, and the submap that is made of what they give."""
        raw = self._sensor()
        step3 = regularise(raw)
        step4 = self._fused(step3)
        step5 = with_calibrated_variance(regularise(step4.map), step4)
        submap = FusedKeyframe(self._own, step5, step4.views.numpy())
        return {
            "sensor": self._sensor,
            "Step 3": lambda: regularise(raw),
            "Step 4": lambda: self._fused(step3),
            "Step 5": lambda: with_calibrated_variance(regularise(step4.map), step4),
            "Step 6": lambda: self._points(step5),
            "submap": lambda: make_submap(submap, self._camera, VOXEL_M),
        }

    def all_steps(self) -> Any:
        """From the sensor's depth to points and normals."""
        fused = self._fused(regularise(self._sensor()))
        return self._points(with_calibrated_variance(regularise(fused.map), fused))

    def _sensor(self) -> Map:
        return from_sensor(self._own.depth_m, self._camera, self._measurement)

    def _fused(self, own: Map) -> Fused:
        return fuse(own, self._views, self._camera, self._image)

    def _points(self, given: Map) -> Any:
        return back_project(given, self._camera), surface_normals(given, self._camera)
