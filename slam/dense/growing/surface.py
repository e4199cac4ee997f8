"""The surface of a live run while it grows: what is there is integrated, what moved is followed.

What it should hold is known: the keyframes that are fused, and the stored frames around which
keyframes are fused, at the poses that tracking sent last. Each ``step``, the work of one frame at
the most, brings it nearer to that. So neither a process that was killed nor a loop that moves
everything is a case of its own.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping

import numpy as np

from bmask_slam.dense.folder import DenseFolder
from bmask_slam.dense.growing.store import FrameStore
from bmask_slam.dense.options import MapOptions
from bmask_slam.dense.surface import gated_frame, keyframe_as_frame, unmasked_depth_m
from bmask_slam.graph.arrays import Array, Floats
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.geometry import transform
from bmask_slam.mapping.inverse_depth.dense_mapper import FusedKeyframe
from bmask_slam.mapping.inverse_depth.depth_map import MeasurementConfig
from bmask_slam.mapping.surface.depth_frame import DepthFrame, depth_frame
from bmask_slam.mapping.surface.extraction import (
    MIN_WITNESSES,
    Surface,
    extract,
    without_crumbs,
)
from bmask_slam.mapping.surface.following import FollowingSurface
from bmask_slam.mapping.surface.gate import KeyframeSurface
from bmask_slam.mapping.surface.parts import (
    Region,
    SurfacePart,
    as_part,
    extract_region,
    regions_of,
)
from bmask_slam.mapping.surface.volume import SurfaceVolume

logger = logging.getLogger(__name__)

NEAR, APART_M, AHEAD_M = 12, 2.5, 1.5
"""A frame is judged by so many keyframes: those that look at points nearest to what it looks at,
which is so far ahead of the camera."""
POINT_STEP_PX, CACHED = 4, 40
"""Every fourth pixel of a keyframe is a point of the judge; so many keyframes' are kept."""
PATIENCE = 30
FRESH = 4
"""So many keyframes that were just fused are kept, to be integrated without reading them."""
PART_VOXELS, PARTS_AT_ONCE = 2, 3
"""Parts for a viewer have one vertex in a cell of two voxels; and how many are made at once."""


class GrowingSurface:
    """A surface of keyframes in a dense map's folder, and of stored frames between them.

    A keyframe's number is -1 - its id, that of a frame its index.

    Attributes:
        fused: ids of the keyframes that are fused.
        frames: where other frames are.
    """

    def __init__(
        self,
        folder: DenseFolder,
        frames: FrameStore,
        camera: Camera,
        options: MapOptions,
        measurement: MeasurementConfig,
        excluded: list[int],
    ) -> None:
        """``options`` are resolved; ``excluded`` are the numbers of the classes left out.

        Raises:
            InputError: the volume cannot be stored.
        """
        self.fused = set(folder.finished())
        self.frames = frames
        self._folder, self._camera, self._options = folder, camera, options
        self._excluded, self._measurement = excluded, measurement
        self._poses: dict[int, Array] = {}
        self._judges: dict[int, list[int]] = {}
        self._points: OrderedDict[int, Floats] = OrderedDict()
        self._fresh: OrderedDict[int, FusedKeyframe] = OrderedDict()
        volume = SurfaceVolume(options.surface_voxel_m, camera, folder=folder.path)
        self._surface = FollowingSurface(volume, self._load)
        self._following: Iterator[tuple[int, bool]] | None = None
        self._is_checked, self._turn, self._added = True, False, 0
        self._changed: set[int] = set()
        self._waiting: set[Region] = set()
        self._given: dict[Region, int] = {}  # in which order they were looked at last
        self._shown: set[Region] = set()

    @property
    def integrated(self) -> int:
        """How many frames are in it, besides keyframes."""
        return sum(number >= 0 for number in self._surface)

    def place(self, poses: Mapping[int, Array]) -> None:
        """The keyframes' T_world_camera (4, 4) of now, by id, also of those that frames follow.

        What follows others leaves the surface.
        """
        self._poses, self._is_checked = dict(poses), False

    def add(self, result: FusedKeyframe) -> None:
        """A keyframe is fused, and in the folder."""
        self.fused.add(result.keyframe.id)
        self._fresh[result.keyframe.id] = result
        if len(self._fresh) > FRESH:
            self._fresh.popitem(last=False)

    def mask(self, keyframe_id: int) -> None:
        """Some of a keyframe's pixels were cut out: what was judged by it is integrated again."""
        self._points.pop(keyframe_id, None)
        self._fresh.pop(keyframe_id, None)
        judged = [n for n, by in self._judges.items() if keyframe_id in by]
        self._changed |= {-1 - keyframe_id, *judged} & set(self._surface)
        self._is_checked = False

    def reopen(self) -> None:
        """Know the keyframes that are in the folder, which is another one."""
        self.fused, self._is_checked = set(self._folder.finished()), False

    def remove(self, keyframe_ids: Collection[int]) -> None:
        """These keyframes are not in the map any more."""
        self.fused -= set(keyframe_ids)
        for number in keyframe_ids:
            self._points.pop(number, None)
            self._fresh.pop(number, None)
        self._is_checked = False

    def due(self, ended: bool = False) -> list[int]:
        """What can be integrated, keyframes first; if all has ``ended``, frames need not wait."""
        here, newest = set(self._surface), max(self.fused & self._poses.keys(), default=-1)
        keyframes = [-1 - k for k in sorted(self.fused & self._poses.keys()) if -1 - k not in here]
        return keyframes + [
            number
            for number, place in self.frames.places.items()
            if number not in here
            and place.reference in self._poses
            and (ended or place.after < newest)
        ]

    def step(self, ended: bool = False) -> bool:
        """Integrate a frame, or follow poses a little; whether there was something to do.

        Raises:
            InputError: the disk is full; it cannot be used any more.
        """
        due, self._turn = self.due(ended), not self._turn
        has_time = not due or self._added >= PATIENCE
        follows = self._following is not None or (has_time and not self._is_checked)
        if due and (self._turn or not follows):
            self._integrate(due[0])
            return True
        if not follows:
            return False
        if self._following is None:
            self._begin_following()
        for _, was_read in self._following or ():
            if was_read:
                return True
        self._following, self._added = None, 0
        return True

    def _integrate(self, number: int) -> None:
        frame = self._load(number, self._pose(number))
        self._added += 1
        if frame is not None:
            self._surface.add(number, frame)
        elif number < 0:
            self.fused.discard(-1 - number)
        else:
            self.frames.forget(number)

    def _begin_following(self) -> None:
        """Find what moved since it was integrated."""
        self._is_checked = True
        known = {n: self._pose(n) for n in self._surface if self._is_known(n)}
        gone = set(self._surface) - known.keys()
        changed, self._changed = self._changed & known.keys(), set()
        if gone or changed or self._surface.moved(known):
            self._following = self._surface.following(known, gone, changed)

    def _is_known(self, number: int) -> bool:
        """Whether it still has a pose and images."""
        if number < 0:
            return -1 - number in self.fused and -1 - number in self._poses
        place = self.frames.places.get(number)
        return place is not None and place.reference in self._poses

    def _pose(self, number: int) -> Array:
        if number < 0:
            return self._poses[-1 - number]
        place = self.frames.places[number]
        return self._poses[place.reference] @ place.T_reference_camera

    def _load(self, number: int, T_world_camera: Array) -> DepthFrame | None:
        """A keyframe or frame at a pose; None if it is not there any more or broken."""
        camera, options = self._camera, self._options
        if not self._is_known(number):
            return None  # removed while poses were followed
        try:
            if number < 0:
                voxel_m, fresh = options.surface_voxel_m, self._fresh.pop(-1 - number, None)
                if fresh is not None:
                    rgb = fresh.keyframe.rgb
                    return depth_frame(fresh.map.cpu(), rgb, T_world_camera, camera, voxel_m)
                return keyframe_as_frame(self._folder, -1 - number, T_world_camera, camera, voxel_m)
            images = self.frames.load(number)
            self._judges[number] = near = self._near(T_world_camera)
            gate = KeyframeSurface.near(self._points_of(near), camera)
        except InputError as error:
            logger.warning("%s; not in the surface", error)
            return None
        measured_m = self._measurement, options.surface_voxel_m
        return gated_frame(images, T_world_camera, gate, camera, *measured_m)

    def _near(self, T_world_camera: Array) -> list[int]:
        """The keyframes that look at about the same place, the nearest first."""
        ids = sorted(self.fused & self._poses.keys())
        seen = np.array([0.0, 0.0, AHEAD_M])
        places = np.array([transform(self._poses[k], seen) for k in ids]).reshape(-1, 3)
        apart_m = np.linalg.norm(places - transform(T_world_camera, seen), axis=1)
        order = np.argsort(apart_m, kind="stable")[:NEAR]
        return [ids[k] for k in order if apart_m[k] < APART_M]

    def _points_of(self, keyframe_ids: list[int]) -> Floats:
        """Points (N, 3) of keyframes in the world."""
        found = [np.zeros((0, 3), np.float32)]
        for number in keyframe_ids:
            if number not in self._points:
                self._points[number] = self._points_camera(number)
            self._points.move_to_end(number)
            T = self._poses[number].astype(np.float32)
            found.append(self._points[number] @ T[:3, :3].T + T[:3, 3])
        while len(self._points) > CACHED:
            self._points.popitem(last=False)
        return np.concatenate(found)

    def _points_camera(self, keyframe_id: int) -> Floats:
        try:
            depth_m = unmasked_depth_m(self._folder, keyframe_id, self._excluded)
        except InputError as error:
            logger.warning("%s; frames are judged without it", error)
            return np.zeros((0, 3), np.float32)
        some = depth_m[::POINT_STEP_PX, ::POINT_STEP_PX]
        v, u = np.nonzero(np.isfinite(some))
        pixels = POINT_STEP_PX * np.stack([u, v], axis=-1).astype(float)
        points = self._camera.backproject(pixels, some[v, u].astype(float))
        return np.asarray(points, np.float32)

    def whole(self) -> Surface:
        """The surface of all that has come. Raises InputError: the disk is full."""
        while self.step(ended=True):
            pass
        volume = self._surface.volume
        least = MIN_WITNESSES if self.integrated else 1
        return without_crumbs(extract(volume, least), self._options.surface_voxel_m)

    def changed_parts(self, most: int = PARTS_AT_ONCE) -> list[SurfacePart]:
        """At most so many parts that have changed: new ones first, then those given longest ago.

        Parts that lack frames, while poses are followed, come later.
        """
        surface, volume = self._surface, self._surface.volume
        self._waiting |= regions_of(surface.take_changed())
        lacking = regions_of(volume.keys[np.flatnonzero(surface.stale.numpy())])
        parts: list[SurfacePart] = []
        for region in sorted(self._waiting - lacking, key=lambda r: (self._given.get(r, -1), r)):
            if len(parts) == most:
                break
            self._waiting.remove(region)
            self._given[region] = max(self._given.values(), default=0) + 1
            seen = extract_region(volume, region)
            if len(seen.triangles) or region in self._shown:
                self._shown.add(region)
                parts.append(as_part(region, seen, PART_VOXELS * volume.voxel_m))
        return parts
