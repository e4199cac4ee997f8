"""When a live run's results are published: poses at once, maps and health from time to time."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import asdict, replace
from typing import Any, Protocol

import numpy as np

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.live.ros2.grid import GridOptions, LiveCloud, LiveGrid
from bmask_slam.live.ros2.outputs import Robot, Ros2Frames, Ros2Outputs
from bmask_slam.live.ros2.transport import Node
from bmask_slam.mapping.products.occupancy import UNKNOWN, OccupancyGrid
from bmask_slam.tracking.results import FrameResult, TrackingStatus

logger = logging.getLogger(__name__)

PERIOD_S, OBJECTS_S, GRID_S = 1.0, 3.0, 5.0
"""Between two messages with path, landmarks and health; with objects; with grid and cloud."""
GRID_SHARE = 0.1
"""Of a processor that grid and cloud may take: they are made less often if it takes longer."""
MAP_SHARE = 0.05
"""Of the time that path and landmarks may take, beside tracking: in a long run they take longer."""
NICENESS = 15
MAX_POSES, MAX_POINTS = 1000, 20_000
"""Of the path, and of landmarks, those seen most often, in a message."""


class LiveRun(Protocol):
    """What ``Ros2Publisher`` asks of a live run; `LiveSlam` has it."""

    def map(self) -> LandmarkCloud: ...
    def trajectory(self) -> Trajectory: ...
    def health(self) -> Any: ...
    def segment(self) -> int: ...
    def keyframe_poses(self) -> dict[int, Array]: ...
    def objects(self) -> MapObjects | None: ...
    def on_submap(self, listener: Callable[[int, Floats, Bytes], None]) -> None: ...


class Ros2Publisher:
    """Called with the result of each frame; publishes it, and maps and health when they are due.

    A frame of another map segment than the largest is as good as lost: its pose is in no frame
    that ROS knows, until the two are joined.
    """

    def __init__(self, node: Node, frames: Ros2Frames, robot: Robot) -> None:
        self._outputs, self._ros_time = Ros2Outputs(node, frames, robot), robot.ros_time
        self._T_map_world, self._voxel_m = robot.T_base_camera, frames.cloud_voxel_m
        self._grid_options = GridOptions(
            frames.grid_resolution_m,
            frames.grid_low_m,
            frames.grid_high_m,
            frames.floor_m if robot.is_known else None,
        )
        self._begin()
        self._thread = ThreadPoolExecutor(1, "grid", _with_low_priority)
        self._making: Future[float] | None = None
        self._run: LiveRun | None = None
        self._last_s = 0.0
        self._told: MapObjects | None = None
        self._has_grid = False

    def __call__(self, result: FrameResult, run: LiveRun) -> None:
        """Publish a result, and what is due."""
        if run is not self._run:
            if self._run is not None:
                self._clear(self._ros_time(result.timestamp_s))
            self._run = run
            run.on_submap(self._add_submap)
        if result.segment != self._segment and result.status is not TrackingStatus.LOST:
            self._segment_may_have_changed(run)
        self._outputs.frame(result, known=result.segment == self._segment)
        self._last_s = result.timestamp_s
        stamp_s = self._ros_time(self._last_s)
        if self._is_due("health", PERIOD_S):
            self._publish_health(stamp_s, run)
        if self._is_due("map", PERIOD_S):
            begin_s = time.monotonic()
            self._publish_map(stamp_s, run)
            took_s = time.monotonic() - begin_s
            self._due_s["map"] = begin_s + max(PERIOD_S, took_s / MAP_SHARE)
        if self._is_due("objects", OBJECTS_S):
            self._publish_objects(stamp_s, run)
        if self._is_due("grid", GRID_S):
            self._publish_grid(stamp_s, run)

    def finish(self, run: LiveRun) -> None:
        """Publish everything of a run that has ended, as it was optimised at its end."""
        if run is not self._run:  # it has tracked nothing
            return
        stamp_s = self._ros_time(self._last_s)
        self._publish_health(stamp_s, run)
        self._publish_map(stamp_s, run)
        self._publish_objects(stamp_s, run)
        wait([self._making] if self._making else [])
        self._make_grid(stamp_s, run.keyframe_poses())

    def _begin(self) -> None:
        """Nothing is known of a run's map yet, and everything is due."""
        self._segment = 0
        self._due_s = {"health": 0.0, "map": 0.0, "objects": 0.0, "grid": 0.0}
        self._grid = LiveGrid(self._T_map_world, self._grid_options)
        self._cloud = LiveCloud(self._T_map_world, self._voxel_m)
        self._failed = False

    def _clear(self, stamp_s: float) -> None:
        """Another run has begun: what was published of the one before is none of its map."""
        wait([self._making] if self._making else [])
        self._begin()
        self._outputs.begin()
        if self._told is not None:
            self._outputs.objects(stamp_s, replace(self._told, objects=[]))
        none = np.zeros((0, 3))
        self._outputs.cloud(stamp_s, none, none.astype(np.uint8))
        if self._has_grid:
            unknown = np.full((1, 1), UNKNOWN, np.int8)
            nothing = OccupancyGrid(self._grid_options.resolution_m, np.zeros(2), unknown)
            self._outputs.grid(stamp_s, nothing, 0.0)
            self._has_grid = False

    def _add_submap(self, number: int, points: Floats, colours: Bytes) -> None:
        self._grid.add(number, points)
        self._cloud.add(number, points, colours)

    def _segment_may_have_changed(self, run: LiveRun) -> None:
        segment = run.segment()
        if segment != self._segment:
            logger.info("map segment %d is the largest now: poses are in its frame", segment)
            self._segment = segment

    def _is_due(self, name: str, period_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < self._due_s[name]:
            return False
        self._due_s[name] = now_s + period_s
        return True

    def _publish_map(self, stamp_s: float, run: LiveRun) -> None:
        cloud, path = run.map(), run.trajectory().poses_world_camera
        path = path[:: len(path) // MAX_POSES + 1]
        best = np.argsort(-cloud.observations, kind="stable")[:MAX_POINTS]
        self._outputs.map(stamp_s, path, cloud.points_world[best], cloud.colours[best])

    def _publish_health(self, stamp_s: float, run: LiveRun) -> None:
        health = asdict(run.health())
        counts = health.pop("source")
        self._outputs.health(stamp_s, health | counts)

    def _publish_objects(self, stamp_s: float, run: LiveRun) -> None:
        found = run.objects()
        if found is not None and found is not self._told:
            self._told = found
            self._outputs.objects(stamp_s, found)

    def _publish_grid(self, stamp_s: float, run: LiveRun) -> None:
        """Let a thread make the grid, unless it still makes the one before."""
        if self._making is not None:
            if not self._making.done():
                return
            self._due_s["grid"] = max(
                self._due_s["grid"], time.monotonic() + self._making.result() / GRID_SHARE
            )
        self._making = self._thread.submit(self._make_grid, stamp_s, run.keyframe_poses())

    def _make_grid(self, stamp_s: float, poses: dict[int, Array]) -> float:
        """Publish grid and cloud; returns the time of the processor that they took.

        What fails is logged, the first time of a map.
        """
        begin_s = time.thread_time()
        try:
            self._publish_dense(stamp_s, poses)
        except Exception:  # it must end neither tracking nor the run
            if not self._failed:
                text = "a grid or cloud for ROS 2 could not be made; later ones are tried"
                logger.warning(text, exc_info=True)
            self._failed = True
        return time.thread_time() - begin_s

    def _publish_dense(self, stamp_s: float, poses: dict[int, Array]) -> None:
        found = self._grid.grid(poses)
        if found is not None:
            self._outputs.grid(stamp_s, *found)
            self._has_grid = True
        cloud = self._cloud.cloud(poses)
        if cloud is not None:
            self._outputs.cloud(stamp_s, *cloud)


def _with_low_priority() -> None:
    """Let tracking come first; Linux knows a priority of each thread."""
    if hasattr(os, "setpriority"):
        os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)
