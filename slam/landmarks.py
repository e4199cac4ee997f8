"""All landmarks of the map, one array a property; an id is a row and is never used twice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from graph.array_file import Arrays
from graph.geometry import Array, inverse, transform
from slam.subpixel import PATCH_PX

Ints = NDArray[np.int64]
Mask = NDArray[np.bool_]

_COLUMNS: dict[str, tuple[tuple[int, ...], type, float]] = {
    "points_world": ((3,), np.float64, np.nan),
    "descriptors": ((8,), np.uint64, 0),
    "directions": ((3,), np.float64, 0.0),
    "extent": ((), np.float64, 0.0),
    "angles_rad": ((), np.float64, 0.0),
    "colours": ((3,), np.uint8, 0),
    "host": ((), np.int64, -1),
    "last_keyframe": ((), np.int64, -1),
    "patches": ((PATCH_PX, PATCH_PX), np.uint8, 0),
    "patch_views": ((3,), np.float64, np.nan),
    "observations": ((), np.int64, 0),
    "visible": ((), np.int64, 0),
    "found": ((), np.int64, 0),
    "replaced_by": ((), np.int64, -1),
    "alive": ((), np.bool_, False),
    "in_graph": ((), np.bool_, False),
}


class LandmarkTable:
    """Columns over landmark ids; every attribute is an array view of the rows in use.

    Attributes:
        points_world: (N, 3) metres.
        descriptors: (N, 8) uint64, BRISK's bits in the keyframe that saw it last.
        directions: (N, 3) unit vector from the point towards that keyframe's camera.
        extent: (N,) keypoint scale times z there, so that scale at depth z is extent / z.
        angles_rad: (N,) the keypoint's orientation there.
        colours: (N, 3) uint8.
        host: (N,) keyframe that made it; it moves the landmark while it is not in the graph.
        last_keyframe: (N,) newest keyframe that observes it.
        patches: (N, 11, 11) uint8 image patch that sub-pixel registration aligns with.
        patch_views: (N, 3) metres, from the point to the camera that took the patch.
        observations: (N,) keyframes that observe it.
        visible, found: (N,) frames in which it should have been, and was, matched.
        replaced_by: (N,) the landmark that this one was fused into, -1 for none.
        alive, in_graph: (N,) bool.
    """

    points_world: Array
    descriptors: NDArray[np.uint64]
    directions: Array
    extent: Array
    angles_rad: Array
    colours: NDArray[np.uint8]
    host: Ints
    last_keyframe: Ints
    patches: NDArray[np.uint8]
    patch_views: Array
    observations: Ints
    visible: Ints
    found: Ints
    replaced_by: Ints
    alive: Mask
    in_graph: Mask

    def __init__(self) -> None:
        self._size = 0
        self._store: dict[str, NDArray] = {
            name: np.full((1024, *shape), fill, dtype)
            for name, (shape, dtype, fill) in _COLUMNS.items()
        }
        self._make_views()

    def __len__(self) -> int:
        return self._size

    def add(self, columns: dict[str, NDArray]) -> Ints:
        """New landmarks from columns by name; returns their ids (N,)."""
        count = len(columns["points_world"])
        ids = np.arange(self._size, self._size + count)
        self._size += count
        capacity = len(self._store["alive"])
        if self._size > capacity:
            self._grow(max(2 * capacity, self._size))
        self._make_views()
        for name, values in columns.items():
            getattr(self, name)[ids] = values
        self.alive[ids] = True
        self.visible[ids] = self.found[ids] = 1
        return ids

    def extend_to(self, size: int) -> None:
        """Rows up to a size, those that are new not alive: to be filled from another table."""
        self._size = size
        if size > len(self._store["alive"]):
            self._grow(max(2 * len(self._store["alive"]), size))
        self._make_views()

    def living(self, ids: Ints) -> Ints:
        """Those of the ids that are still in the map."""
        ids = ids[ids >= 0]
        return ids[self.alive[ids]]

    def current(self, ids: Ints) -> Ints:
        """The ids (N,) >= 0 that stand for these now, in their order, fused ones followed.

        A late answer about landmarks may name some that were fused or culled meanwhile; those
        that were culled stay as they are, not alive.
        """
        ids = ids.copy()
        while len(fused := np.flatnonzero(self.replaced_by[ids] >= 0)):
            ids[fused] = self.replaced_by[ids[fused]]
        return ids

    def remove(self, ids: Ints) -> None:
        """Take landmarks out of the map; keyframes drop them when they next look."""
        self.alive[ids] = False
        self.in_graph[ids] = False

    def move_with_hosts(self, ids: Ints, keyframe_ids: Ints, T_old: Array, T_new: Array) -> None:
        """Carry landmarks along with their host keyframes from poses T_old to T_new (K, 4, 4)."""
        position = np.searchsorted(keyframe_ids, self.host[ids])
        position = np.minimum(position, len(keyframe_ids) - 1)
        known = keyframe_ids[position] == self.host[ids]
        ids, position = ids[known], position[known]
        T_move = (T_new @ inverse(T_old))[position]
        self.points_world[ids] = transform(T_move, self.points_world[ids][:, None])[:, 0]

    def state(self) -> Arrays:
        """The living landmarks; of dead ones nothing but their number matters any more."""
        ids = np.flatnonzero(self.alive)
        columns = {name: getattr(self, name)[ids] for name in _COLUMNS if name != "alive"}
        return {"size": np.array(self._size), "ids": ids, **columns}

    def restore(self, state: Arrays) -> None:
        """Become the table of a state; this one must be new."""
        self._size = int(state["size"])
        self._grow(max(len(self._store["alive"]), self._size))
        self._make_views()
        for name in _COLUMNS:
            getattr(self, name)[state["ids"]] = True if name == "alive" else state[name]

    def _grow(self, capacity: int) -> None:
        for name, (shape, dtype, fill) in _COLUMNS.items():
            bigger: NDArray = np.full((capacity, *shape), fill, dtype)
            old = self._store[name]
            bigger[: len(old)] = old
            self._store[name] = bigger

    def _make_views(self) -> None:
        for name, array in self._store.items():
            setattr(self, name, array[: self._size])
