"""Sends the state of the live loop to a viewer, a little at each frame."""

from __future__ import annotations

import logging
import time
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.labelling.results import MapObjects
from bmask_slam.live.health import Health
from bmask_slam.live.messages import Masks
from bmask_slam.live.system import LiveSystem
from bmask_slam.semantics.instances.overlay import class_colour
from bmask_slam.tracking.results import FrameResult
from bmask_slam.viewer.scene import Scene
from bmask_slam.viewer.shown import Box, as_jpeg
from bmask_slam.world.world_map import WorldMap

if TYPE_CHECKING:  # it loads torch
    from bmask_slam.live.processes.remote_dense import RemoteDenseMapper

logger = logging.getLogger(__name__)

IMAGE_EVERY = 3
"""Interval in frames of images that are shown."""
OBJECTS_S = 3.0
"""Interval at which the map is asked for its objects."""
MAX_UNSEGMENTED = 8
"""Largest number of keyframes whose images wait for their masks."""
MOVED_AT_ONCE = 10
"""Largest number of submaps that are moved at a frame; the others follow at the next frames."""
PARTS_AT_ONCE = 1
"""Largest number of parts of the surface that are shown at a frame."""
MOVED_M, TURNED = 0.002, 0.001
"""Smallest shift in metres, and change of the rotation matrix, for which a submap is moved."""


class Display:
    """Updates a scene."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._frames = self._changes = 0
        self._placed: dict[int, Array] = {}
        self._to_move: list[int] = []
        self._names: tuple[str, ...] = ()
        self._unsegmented: dict[int, bytes] = {}
        self._asked_s = 0.0
        self._objects: MapObjects | None = None

    def close(self) -> None:
        """End what is shown; a recording that cannot be written to its end is warned about."""
        try:
            self._scene.close()
        except InputError as error:
            logger.warning("%s", error)

    def follow(self, system: LiveSystem) -> None:
        """Show the masks of a system's keyframes as they arrive."""
        self._names = system.label_names
        self._scene.log_names(self._names)
        system.mask_listeners.append(self.masks)

    def masks(self, found: Masks) -> None:
        """Show a keyframe's image with its masks."""
        jpeg = self._unsegmented.pop(found.keyframe_id, None)
        if jpeg is not None:
            self._scene.log_masks(jpeg, found.instances, self._names)

    def frame(self, result: FrameResult, rgb: Image, system: LiveSystem) -> bool:
        """Show a frame, and some changes of the submaps; returns whether the map has changed."""
        self._frames += 1
        self._scene.log_frame(result, rgb if self._frames % IMAGE_EVERY == 1 else None)
        if result.keyframe_id is not None and system.segmenter is not None:
            self._unsegmented[result.keyframe_id] = as_jpeg(rgb)
            for oldest in list(self._unsegmented)[:-MAX_UNSEGMENTED]:
                del self._unsegmented[oldest]
        has_changed = self._changes != system.remote.changes
        self._changes = system.remote.changes
        if system.dense is not None:
            self.submaps(system.dense, system.remote.world, has_changed, MOVED_AT_ONCE)
            self.surface(system.dense, PARTS_AT_ONCE)
        return has_changed

    def map(self, system: LiveSystem, health: Health) -> None:
        """Show landmarks, keyframes, objects and queues."""
        if system.segmenter is not None:
            self._show_objects(system)
        cloud, path = system.landmarks(), system.keyframe_trajectory().positions_world
        self._scene.log_points("world/landmarks", cloud.points_world, cloud.colours, 0.008)
        colours = np.full((len(path), 3), 200, np.uint8)
        self._scene.log_points("world/keyframes", path, colours, 0.02)
        numbers = {k: v for k, v in asdict(health).items() if isinstance(v, int | float)}
        self._scene.log_numbers("health", numbers)

    def surface(self, dense: RemoteDenseMapper, at_once: int) -> None:
        """Show at most so many parts of the surface that have changed."""
        for region in list(dense.shown.parts)[:at_once]:
            self._scene.log_surface_part(dense.shown.parts.pop(region))

    def _show_objects(self, system: LiveSystem) -> None:
        """Show the objects as the map told them last, and ask for newer ones now and then."""
        now_s = time.monotonic()
        if now_s > self._asked_s + OBJECTS_S:
            self._asked_s = now_s
            system.remote.ask_for_objects()
        found = system.remote.objects
        if found is not None and found is not self._objects:
            self._objects = found
            self._scene.log_boxes(_boxes(found))

    def submaps(
        self, dense: RemoteDenseMapper, world: WorldMap, has_changed: bool, at_once: int
    ) -> None:
        """Show at most ``at_once`` finished submaps, and move as many whose keyframes have moved.

        A submap whose keyframe is not in the largest map segment waits until the two are joined.
        """
        if has_changed:
            for removed in self._placed.keys() - world.keyframes.keys():
                del self._placed[removed]
                self._scene.remove_submap(removed)
            self._to_move = self._moved(world)
        for number in self._to_move[:at_once]:
            if number in self._placed and number in world.keyframes:
                self._place(number, world)
        del self._to_move[:at_once]
        segment = world.largest_segment() if dense.previews else 0
        due = [n for n in dense.previews if n in world.keyframes]
        for number in [n for n in due if world.keyframes[n].segment == segment][:at_once]:
            preview = dense.previews.pop(number)
            self._scene.log_submap(number, preview.points, preview.colours)
            self._place(number, world)

    def _moved(self, world: WorldMap) -> list[int]:
        """Submaps whose keyframes have moved since they were placed, the largest motion first."""
        ids = list(self._placed)
        if not ids:
            return []
        shown_poses = np.array([self._placed[i] for i in ids])
        poses = np.array([world.keyframes[i].T_world_camera for i in ids])
        off = np.abs(poses - shown_poses)[:, :3]
        moved = np.maximum(
            off[..., 3].max(axis=1) / MOVED_M, off[..., :3].max(axis=(1, 2)) / TURNED
        )
        return [ids[k] for k in np.argsort(-moved, kind="stable") if moved[k] > 1]

    def _place(self, number: int, world: WorldMap) -> None:
        T = world.keyframes[number].T_world_camera
        self._placed[number] = T.copy()
        self._scene.move_submap(number, T)


def _boxes(found: MapObjects) -> list[Box]:
    return [
        Box(
            o.box,
            f"{found.names.map_name(o.label)} {o.distribution[o.label]:.2f}",
            class_colour(o.label).astype(np.uint8),
        )
        for o in found.objects
    ]
