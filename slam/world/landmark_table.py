"""All landmarks of the map, one array a property; an id is a row and is never used twice."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bmask_slam.features.patch_alignment import PATCH_PX
from bmask_slam.graph.arrays import Array, Arrays, Bytes, Ints, Mask
from bmask_slam.graph.files.array_file import check_ids
from bmask_slam.graph.files.disk_arrays import concatenated
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.world.appearance import (
    APPEARANCE,
    PATCHES,
    Appearance,
    AppearanceTable,
    Columns,
    Patches,
    filled,
)

_OF_ALL: Columns = {
    "points_world": ((3,), np.float64, np.nan),
    "host": ((), np.int32, -1),
    "last_keyframe": ((), np.int32, -1),
    "observations": ((), np.int32, 0),
    "visible": ((), np.int32, 0),
    "found": ((), np.int32, 0),
    "replaced_by": ((), np.int32, -1),
    "in_map": ((), np.bool_, False),
    "in_graph": ((), np.bool_, False),
}
_COLUMNS = _OF_ALL | APPEARANCE
BLOCK = 4096  # landmarks whose appearance is copied at once
_ROW: Columns = {"row": ((), np.int32, 0)}


class LandmarkTable:
    """Columns over landmark ids; every attribute is an array view of the rows in use.

    Integers are int32, since most rows are of removed landmarks, which are kept for ever.

    Attributes:
        points_world: (N, 3) metres.
        descriptors: (N, 8) uint64, BRISK's bits in the keyframe that saw it last.
        directions: (N, 3) unit vector from the point towards that keyframe's camera.
        extent: (N,) keypoint scale times z there; the scale at depth z is extent / z.
        angles_rad: (N,) the keypoint's orientation there.
        colours: (N, 3) uint8.
        host: (N,) keyframe that made it; it moves the landmark while it is not in the graph.
        last_keyframe: (N,) newest keyframe that observes it.
        patches: (N, PATCHES, 17, 17) uint8 image patches that sub-pixel registration aligns with.
        patch_views: (N, PATCHES, 3) metres, from the point to the camera that took each, or NaN.
        observations: (N,) keyframes that observe it.
        visible, found: (N,) frames in which it should have been, and was, matched.
        replaced_by: (N,) the landmark that this one was fused into, -1 for none.
        in_map, in_graph: (N,) bool.
        row: (N,) row of its appearance, 0 for removed landmarks.
        spare: (M,) reserved ids that no landmark has got.
        reserved_only: whether new landmarks get reserved ids alone, since there are copies of this
            table that have ids of their own from the last one on.

    Descriptors, directions, extent, angles, colours and patches are kept for landmarks in the map
    only; those of removed landmarks are zero, and their rows are used again.
    """

    points_world: Array
    descriptors: Appearance
    directions: Appearance
    extent: Appearance
    angles_rad: Appearance
    colours: Appearance
    host: Ints
    last_keyframe: Ints
    patches: Appearance
    patch_views: Appearance
    observations: Ints
    visible: Ints
    found: Ints
    replaced_by: Ints
    in_map: Mask
    in_graph: Mask
    row: Ints

    def __init__(self) -> None:
        self._size = 0
        self.spare: Ints = np.zeros(0, np.int64)
        self.reserved_only = False
        self._store = {name: filled(1024, column) for name, column in (_OF_ALL | _ROW).items()}
        self._appearance = AppearanceTable()
        self._make_views()

    def __len__(self) -> int:
        return self._size

    def add(self, columns: Arrays, ids: Ints | None = None) -> Ints:
        """New landmarks from columns by name; returns their ids (N,), -1 where none was left.

        They get the ids (N,) that are given, if any; where such an id is -1, one of their own.
        """
        count = len(columns["points_world"])
        ids = np.full(count, -1, np.int64) if ids is None else ids.copy()
        without = np.flatnonzero(ids < 0)
        own = self._next_ids(len(without))
        ids[without[: len(own)]] = own
        rows = np.flatnonzero(ids >= 0)
        made = ids[rows]
        self._assign_rows(made)
        for name, values in columns.items():
            getattr(self, name)[made] = values[rows]
        self.in_map[made] = True
        self.visible[made] = self.found[made] = 1
        return ids

    def _next_ids(self, count: int) -> Ints:
        """Ids (N,) for so many new landmarks, or as many as there are."""
        if self.reserved_only:
            ids, self.spare = self.spare[:count], self.spare[count:]
            return ids
        self.extend_to(self._size + count)
        return np.arange(self._size - count, self._size)

    def reserve(self, first: int, end: int, given: Ints) -> None:
        """Reserve the ids from ``first`` to before ``end``; those (N,) ``given`` are not spare."""
        self.extend_to(max(end, self._size))
        self.spare = np.concatenate([self.spare, np.setdiff1d(np.arange(first, end), given)])

    def extend_to(self, size: int) -> None:
        """Add rows up to a size, not in the map, to be filled from another table."""
        self._release_rows(np.arange(size, self._size))
        capacity, old = len(self._store["in_map"]), self._size
        for name, (shape, dtype, fill) in (_OF_ALL | _ROW).items():
            if size > capacity:
                bigger: NDArray = np.empty((max(2 * capacity, size), *shape), dtype)
                bigger[:old] = self._store[name][:old]
                self._store[name] = bigger
            self._store[name][old:size] = fill
        self._size = size
        self._make_views()

    def set_in_map(self, in_map: Mask) -> None:
        """Set which of all landmarks (N,) are in the map; the appearance of new ones is zero."""
        self._release_rows(np.flatnonzero((self.row > 0) & ~in_map))
        self._assign_rows(np.flatnonzero((self.row == 0) & in_map))
        self.in_map[:] = in_map

    def written_since(self, revision: int) -> tuple[Mask, int]:
        """Landmarks (N,) whose appearance was written after a revision, and the present one."""
        revisions = self._appearance.revisions
        revisions.now += 1
        return revisions.rows[self.row] > revision, revisions.now - 1

    def remaining(self, ids: Ints) -> Ints:
        """Those of the ids that are in the map."""
        ids = ids[ids >= 0]
        return ids[self.in_map[ids]]

    def rarely_found(self, ids: Ints, ratio: float) -> Mask:
        """Whether landmarks (N,) were found in less than this share of the frames to show them."""
        return self.found[ids] < ratio * self.visible[ids]

    def current(self, ids: Ints) -> Ints:
        """The present ids (N,) of landmarks (N,) that may have been fused since, in the same order.

        Ids are >= 0. Ids of removed landmarks are returned unchanged.
        """
        ids = ids.copy()
        while len(fused := np.flatnonzero(self.replaced_by[ids] >= 0)):
            ids[fused] = self.replaced_by[ids[fused]]
        return ids

    def remove(self, ids: Ints) -> None:
        """Remove landmarks from the map; keyframes drop them when they are next read."""
        self.in_map[ids] = False
        self.in_graph[ids] = False
        self._release_rows(np.unique(ids))

    def patch_distances(self, ids: Ints, views: Array, limits: tuple[float, float]) -> Array:
        """Distances (N, PATCHES) of patches from views (N, 3), as shares of the limits.

        The limits are an angle in radians and a ratio of distances, of which the larger share
        counts. Infinite where there is no patch.
        """
        max_turn_rad, max_zoom = limits
        view_vectors = self.patch_views[ids]
        distance_there = np.linalg.norm(view_vectors, axis=-1)
        distance_here = np.linalg.norm(views, axis=-1)[:, None]
        cosine = np.einsum("nj,nvj->nv", views, view_vectors) / (distance_here * distance_there)
        turn = np.arccos(np.clip(cosine, -1, 1)) / max_turn_rad
        zoom = np.abs(np.log(distance_here / distance_there)) / np.log(max_zoom)
        return np.nan_to_num(np.maximum(turn, zoom), nan=np.inf, posinf=np.inf)

    def nearest_patches(
        self, ids: Ints, centre_world: Array, limits: tuple[float, float]
    ) -> tuple[Bytes, Array]:
        """Of every landmark the patch (N, 17, 17) of the view nearest to that of a camera (3,).

        Also its zoom (N,): the scale in the camera's image relative to the patch.
        """
        views = centre_world - self.points_world[ids]
        nearest = self.patch_distances(ids, views, limits).argmin(axis=1)
        view_vectors = self.patch_views.pick(ids, nearest)
        zooms = np.linalg.norm(view_vectors, axis=1) / np.linalg.norm(views, axis=1)
        return self.patches.pick(ids, nearest), np.nan_to_num(zooms, nan=1.0)

    def patches_of(self, ids: Ints) -> Patches:
        """All patches of landmarks (N,); none for an id of -1."""
        images = np.zeros((len(ids), PATCHES, PATCH_PX, PATCH_PX), np.uint8)
        views, known = np.full((len(ids), PATCHES, 3), np.nan), ids >= 0
        images[known], views[known] = self.patches[ids[known]], self.patch_views[ids[known]]
        return Patches(images, views)

    def give_patches(self, ids: Ints, patches: Patches) -> None:
        """Store patches of landmarks (N,), each given once, that have no patch."""
        without = np.isnan(self.patch_views[ids]).all(axis=(1, 2))
        self.patches[ids[without]] = patches.images[without]
        self.patch_views[ids[without]] = patches.views[without]

    def put_patches(self, ids: Ints, slots: Ints, patches: Bytes, views: Array) -> None:
        """Store patches (N, 17, 17) and their views (N, 3) of landmarks (N,), each given once."""
        for column, values in ((self.patches, patches), (self.patch_views, views)):
            all_slots = column[ids]
            all_slots[np.arange(len(ids)), slots] = values
            column[ids] = all_slots

    def move_with_hosts(self, ids: Ints, keyframe_ids: Ints, T_old: Array, T_new: Array) -> None:
        """Carry landmarks along with their host keyframes from poses T_old to T_new (K, 4, 4)."""
        row_of = np.full(max(self.host.max(initial=-1), keyframe_ids.max()) + 2, -1)
        row_of[keyframe_ids] = np.arange(len(keyframe_ids))
        position = row_of[self.host[ids]]  # -1, also for a host of -1, if it does not move
        ids, position = ids[position >= 0], position[position >= 0]
        T_move = (T_new @ inverse(T_old))[position]
        self.points_world[ids] = transform(T_move, self.points_world[ids][:, None])[:, 0]

    def release_memory(self) -> None:
        """Give back the memory of patches that were read from the disk."""
        self._appearance.release_memory()

    def state(self) -> Arrays:
        """The landmarks in the map; of removed ones only the number is kept."""
        ids = np.flatnonzero(self.in_map)
        columns = {name: self._rows_of(ids, name) for name in _COLUMNS if name != "in_map"}
        return {"size": np.array(self._size), "ids": ids, **columns, "spare": self.spare}

    def _rows_of(self, ids: Ints, name: str) -> NDArray:
        column = getattr(self, name)
        like = column[ids[:0]]
        if like.dtype == np.int32:
            return column[ids].astype(np.int64)  # as files have it
        pieces = (column[ids[k : k + BLOCK]] for k in range(0, len(ids), BLOCK))
        return concatenated(pieces, len(ids), like)

    def restore(self, state: Arrays) -> None:
        """Become the table of a state; this table must be new. Raises ValueError."""
        self.spare = state.get("spare", self.spare)  # of older files there is none
        check_ids(np.concatenate([state["ids"], self.spare]), int(state["size"]))
        if (state["replaced_by"] >= 0).any():
            raise ValueError("a landmark of the map that was fused into another")
        self.extend_to(int(state["size"]))
        self._assign_rows(state["ids"])
        for name in _COLUMNS:
            getattr(self, name)[state["ids"]] = True if name == "in_map" else state[name]

    def _assign_rows(self, ids: Ints) -> None:
        """Assign rows of the appearance to landmarks (N,) that have none."""
        if self._appearance.reserve(len(ids)):
            self._make_views()
        self.row[ids] = self._appearance.take(len(ids))

    def _release_rows(self, ids: Ints) -> None:
        """Release the rows of landmarks (N,), each given once, and set them to zero."""
        used = self.row[ids]
        self.row[ids] = 0
        self._appearance.clear(used[used > 0])

    def _make_views(self) -> None:
        for name, array in self._store.items():
            setattr(self, name, array[: self._size])
        for name, column in self._appearance.views(self.row).items():
            setattr(self, name, column)


def ends_of_chains(old_ids: Ints, new_ids: Ints) -> tuple[Ints, Ints]:
    """The duplicates (M,), ascending, and what each is in the end, also if that is a duplicate."""
    old, last = np.unique(old_ids[::-1], return_index=True)
    new = new_ids[::-1][last]
    while len(again := np.flatnonzero(np.isin(new, old))):
        new[again] = new[np.searchsorted(old, new[again])]
    return old, new
