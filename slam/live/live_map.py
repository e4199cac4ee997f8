"""The map of a live run while it grows: what it is asked, and what is added to it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bmask_slam.graph.arrays import Array, Bytes, Floats
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.sensors.streams import Measurements
from bmask_slam.graph.trajectory import Trajectory
from bmask_slam.labelling.results import LandmarkCloud, MapObjects
from bmask_slam.live.messages import MapSaved, SaveMap
from bmask_slam.live.start import LiveOptions
from bmask_slam.live.system import LiveSystem
from bmask_slam.sensor_input import SensorInput

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.mapping.surface.parts import SurfacePart

MAX_MAP_WAIT_S = 1.0
"""Longest time that one call of ``catch_up`` waits for the map."""


class LiveMap(SensorInput):
    """What `LiveSlam` has besides frames; its methods are for the thread that tracks."""

    options: LiveOptions
    _system: LiveSystem

    def add_measurements(self, new: Measurements) -> None:
        """Use the measurements of a sensor with the next frame; from any thread."""
        self._system.add_measurements(new)

    def add_factor(self, factor: Any) -> int:
        """See `SensorInput.add_factor`; from the thread that tracks. A refusal is an event."""
        return self._system.add_factor(factor)

    def remove_factor(self, number: int) -> None:
        """See `SensorInput.remove_factor`."""
        self._system.remove_factor(number)

    @property
    def calibration(self) -> str:
        """What was found of the camera, in one line; "" if nothing, or if it was not tried."""
        found = self._system.calibration
        texts = "" if found is None else found.text, self._system.covered
        return "; ".join(filter(None, texts))

    def trajectory(self) -> Trajectory:
        """Every frame of the largest map segment so far, from the keyframes' present poses."""
        return self._system.trajectory()

    def map(self) -> LandmarkCloud:
        """The landmarks of the largest map segment at present."""
        return self._system.landmarks()

    def catch_up(self, waiting: float = math.inf) -> None:
        """Apply the other processes' results; wait until at most ``waiting`` keyframes are pending.

        With a finite ``waiting`` it also waits for masks that are urgent, and while the dense map
        would drop a keyframe. The wait ends after ``MAX_MAP_WAIT_S``, unless the camera is being
        estimated, for at most ``remote_calibration.WAIT_S``.
        """
        deadline_s = time.monotonic() + MAX_MAP_WAIT_S
        self._system.catch_up()
        while self._is_estimating(waiting) or (
            self._is_behind(waiting) and time.monotonic() < deadline_s
        ):
            time.sleep(0.001)
            self._system.catch_up()

    def _is_estimating(self, waiting: float) -> bool:
        found = self._system.calibration
        return found is not None and waiting < math.inf and found.is_awaited

    def _is_behind(self, waiting: float) -> bool:
        system = self._system
        is_full = system.dense is not None and system.dense.full
        is_urgent = system.segmenter is not None and bool(system.segmenter.urgent)
        others = waiting < math.inf and (is_full or is_urgent)
        return others or (system.remote.pending > waiting and not system.remote.given_up)

    def processes(self) -> dict[str, int]:
        """Process ids by name; that of the calibration until the camera is settled."""
        system = self._system
        owners = {"map": system.remote, "segmenter": system.segmenter, "dense": system.dense}
        pids = {name: part.worker.pid for name, part in owners.items() if part is not None}
        if system.calibration is not None and not system.calibration.done:
            pids["calibration"] = system.calibration.pid
        return {name: pid for name, pid in pids.items() if pid}  # 0: none here

    def segment(self) -> int:
        """The number of the largest map segment, which ``map`` and ``trajectory`` are of."""
        return self._system.largest_segment()

    def keyframe_poses(self) -> dict[int, Array]:
        """The present T_world_camera (4, 4) of the keyframes of the largest segment, by id."""
        shown = self._system.map.world.in_segment(self.segment())
        return {k.id: k.T_world_camera for k in shown}

    def objects(self) -> MapObjects | None:
        """The objects as the map's process told them last; it is asked for newer ones.

        None before its first answer, and without a segmenter. After ``close`` those that are saved.
        """
        system = self._system
        if system.segmenter is None:
            return None
        if system.map is not system.remote:  # it has ended
            return system.objects()
        system.remote.ask_for_objects()
        return system.remote.objects

    def on_submap(self, listener: Callable[[int, Floats, Bytes], None]) -> None:
        """Call with each submap of the dense map: its keyframe's id, points (N, 3) and colours.

        The points are in the keyframe's frame. Nothing is called without a dense map, or with
        `LiveOptions.submap_points` 0.
        """
        dense = self._system.dense
        if dense is not None:
            dense.listeners.append(listener)
            dense.keeps_previews = self.options.view.enabled

    def on_surface(self, listener: Callable[[SurfacePart], None]) -> None:
        """Call with each part of the dense map's growing surface that has changed, a few a second.

        A part replaces what came before of its region; it has one vertex in a cell of two voxels,
        in the world of the largest map segment. Nothing is called without a dense map.
        """
        if self._system.dense is not None:
            self._system.dense.show_surface(listener)

    @property
    def extends(self) -> bool:
        """Whether keyframes are made; False: frames are only located in the map as it is."""
        return self._system.remote.extends

    @extends.setter
    def extends(self, extends: bool) -> None:
        if not extends and not self._system.remote.world.keyframes:
            raise InputError("there is no map yet to be located in")
        self._system.remote.extends = extends

    def save_map(self, path: Path) -> None:
        """Let the map's process write a file as RUN/map; ``saved_maps`` says when it is there.

        A relative path is one of the folder where the program is now; ``saved_maps`` has it whole.
        """
        self._system.remote.send(SaveMap(path.absolute()))

    def saved_maps(self) -> list[MapSaved]:
        """What was saved since the last call, or why not."""
        saved = list(self._system.remote.maps_saved)
        self._system.remote.maps_saved.clear()
        return saved
