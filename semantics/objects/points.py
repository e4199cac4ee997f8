"""Tables of what belongs to objects: points in keyframes' frames, sightings, landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Floats, Ints, numbered
from bmask_slam.graph.geometry import transform

_GOLDEN = 0.6180339887


@dataclass(frozen=True, eq=False)
class Sightings:
    """The objects (D,) that a keyframe with a timestamp observed."""

    keyframe_id: int
    timestamp_s: float
    objects: Ints


class ObjectPoints:
    """Tables of points, sightings and landmarks, each row with its object."""

    def __init__(self) -> None:
        self._next_id = 0
        self._points: Floats = np.zeros((0, 3), np.float32)  # in the anchor keyframe's frame
        self._anchors: Ints = np.zeros(0, np.int64)
        self._owners: Ints = np.zeros(0, np.int64)
        self._covered: Ints = np.zeros((0, 2), np.int64)  # views of the point: under the mask, all
        self._sightings: Ints = np.zeros((0, 2), np.int64)  # object, keyframe
        self._seen_s: Array = np.zeros(0)
        self._landmarks: Ints = np.zeros((0, 2), np.int64)  # landmark, object

    def new_ids(self, count: int) -> Ints:
        """Ids (count,) that were not used before."""
        ids = np.arange(self._next_id, self._next_id + count)
        self._next_id += count
        return ids

    def add(self, sightings: Sightings, points: Array, owners: Ints) -> None:
        """Add sightings, and points (P, 3) of objects (P,) in the frame of their keyframe."""
        count = len(sightings.objects)
        pairs = np.stack([sightings.objects, np.full(count, sightings.keyframe_id)], axis=1)
        self._sightings = np.concatenate([self._sightings, pairs])
        self._seen_s = np.append(self._seen_s, np.full(count, sightings.timestamp_s))
        self._points = np.concatenate([self._points, points.astype(np.float32)])
        self._anchors = np.append(self._anchors, np.full(len(points), sightings.keyframe_id))
        self._owners = np.append(self._owners, owners)
        self._covered = np.concatenate([self._covered, np.ones((len(points), 2), np.int64)])

    def cover(self, rows: Ints, under: Ints, detected: Ints) -> None:
        """Count a view that shows rows of points (N,), each under the mask of an object (N,) or -1.

        It has masks of the objects ``detected`` (D,); only points of these count.
        """
        owners = self._owners[rows]
        counts = np.isin(owners, detected)
        self._covered[rows[counts]] += np.stack([under == owners, counts], axis=1)[counts]

    def covered_shares(self, poses: dict[int, Array]) -> Array:
        """Of the views that show a point and its object, the share whose mask of it covers it.

        (N,), of the rows whose keyframe has a pose.
        """
        under, views = self._covered[self.rows(poses)].T
        return np.asarray(under / views)

    def in_world(self, poses: dict[int, Array]) -> tuple[Ints, Array]:
        """Objects (N,) and world points (N, 3) of the rows whose keyframe has a pose."""
        rows = self.rows(poses)
        anchors, where = numbered(self._anchors[rows])
        T_world_anchor = np.array([poses[k] for k in anchors.tolist()]).reshape(-1, 4, 4)
        points = self._points[rows].astype(float)
        moved = transform(T_world_anchor[where], points[:, None])[:, 0]
        return self._owners[rows], moved

    def rays_in_world(self, poses: dict[int, Array]) -> Array:
        """Displacement (N, 3) of the same rows by an error of z^2 m in the depth z."""
        rows = self.rows(poses)
        anchors, where = numbered(self._anchors[rows])
        R_world_anchor = np.array([poses[k][:3, :3] for k in anchors.tolist()]).reshape(-1, 3, 3)
        points = self._points[rows].astype(float)
        turned = np.einsum("nij,nj->ni", R_world_anchor[where], points)
        return np.asarray(turned * points[:, 2:])

    def views(self, poses: dict[int, Array]) -> Ints:
        """The keyframes (N,) in whose frames the points of the same rows are kept."""
        return self._anchors[self.rows(poses)]

    def rows(self, poses: dict[int, Array]) -> Ints:
        """The rows of points whose keyframe has a pose."""
        return np.flatnonzero(np.isin(self._anchors, list(poses)))

    def reassign(self, rows: Ints, object_id: int) -> None:
        """Give rows of points, and the sightings from their keyframes, to another object."""
        before = np.unique(self._owners[rows])
        chosen = np.isin(self._sightings[:, 0], before)
        chosen &= np.isin(self._sightings[:, 1], self._anchors[rows])
        chosen &= ~np.isin(self._sightings[:, 1], self.sightings(object_id)[0])
        copied = self._sightings[chosen].copy()
        copied[:, 0] = object_id
        self._owners[rows] = object_id
        self._sightings = np.concatenate([self._sightings, copied])
        self._seen_s = np.append(self._seen_s, self._seen_s[chosen])

    def merge(self, kept: int, removed: int) -> None:
        """Give all rows of an object to another."""
        self._owners[self._owners == removed] = kept
        self._landmarks[self._landmarks[:, 1] == removed, 1] = kept
        both = np.where(self._sightings == [removed, -1], [kept, -1], self._sightings)
        _, first = np.unique(both, axis=0, return_index=True)
        first = np.sort(first)
        self._sightings, self._seen_s = both[first], self._seen_s[first]

    def thin(self, most: int) -> None:
        """Keep about so many points an object at most, as many of each view that it has.

        Else the views of one end of a long table would fade while the camera looks at the other.
        """
        sizes = np.bincount(self._owners, minlength=self._next_id)
        if sizes.max(initial=0) <= most:
            return
        order = np.lexsort((self._anchors, self._owners))  # stable
        owners, anchors = self._owners[order], self._anchors[order]
        begins = np.flatnonzero(np.diff(owners, prepend=-1) | np.diff(anchors, prepend=-1))
        counts = np.diff(begins, append=len(order))
        where = np.repeat(np.arange(len(begins)), counts)
        owners, anchors = owners[begins], anchors[begins]  # of each view of an object
        place = np.arange(len(order)) - begins[where]
        views = np.bincount(owners, minlength=self._next_id)[owners]
        share = np.minimum(1.0, np.maximum(0.75 * most / views, 1.0) / counts)
        share[sizes[owners] <= most] = 1.0
        phase = (anchors + views) * _GOLDEN % 1.0  # else always the same ones would go
        share, phase = share[where], phase[where]
        chosen = np.floor((place + 1) * share + phase) > np.floor(place * share + phase)
        kept = np.sort(order[chosen])
        self._points, self._anchors = self._points[kept], self._anchors[kept]
        self._owners, self._covered = self._owners[kept], self._covered[kept]

    def anchors(self) -> list[int]:
        """The keyframes whose frames hold points."""
        return list(np.unique(self._anchors).tolist())

    def reanchor(self, keyframe_id: int, parent_id: int, T_parent_keyframe: Array) -> None:
        """Move the points of a removed keyframe into the frame of its parent."""
        rows = self._anchors == keyframe_id
        self._points[rows] = transform(T_parent_keyframe, self._points[rows].astype(float))
        self._anchors[rows] = parent_id

    def sightings(self, object_id: int) -> tuple[Ints, Array]:
        """Keyframes (K,), ascending, that observed an object, and their timestamps (K,)."""
        rows = np.flatnonzero(self._sightings[:, 0] == object_id)
        rows = rows[np.argsort(self._sightings[rows, 1], kind="stable")]
        return self._sightings[rows, 1], self._seen_s[rows]

    def last_seen_s(self, object_ids: Ints) -> Array:
        """Last timestamp (N,) of objects (N,); -inf for one without a sighting."""
        found = np.full(self._next_id + 1, -np.inf)
        np.maximum.at(found, self._sightings[:, 0], self._seen_s)
        return found[object_ids]

    def place_landmarks(self, landmark_ids: Ints, object_ids: Ints) -> None:
        """Assign landmarks (N,) to objects (N,), in place of earlier assignments."""
        kept = self._landmarks[~np.isin(self._landmarks[:, 0], landmark_ids)]
        placed = np.stack([landmark_ids, object_ids], axis=1)
        both = np.concatenate([kept, placed])
        self._landmarks = both[np.argsort(both[:, 0], kind="stable")]

    def landmarks_of(self, object_id: int) -> Ints:
        """Landmarks (N,) on an object."""
        return self._landmarks[self._landmarks[:, 1] == object_id, 0]

    def landmarks(self) -> Ints:
        """All landmarks (N,) on objects, ascending."""
        return self._landmarks[:, 0]

    def rename_landmarks(self, old_ids: Ints, new_ids: Ints) -> None:
        """Replace landmarks (N,) by those that they were fused into (N,); -1: removed."""
        table = dict(zip(old_ids.tolist(), new_ids.tolist(), strict=True))
        ids = np.array([table.get(i, i) for i in self._landmarks[:, 0].tolist()], np.int64)
        _, first = np.unique(ids, return_index=True)
        first = first[ids[first] >= 0]
        self._landmarks = np.stack([ids[first], self._landmarks[first, 1]], axis=1)

    def state(self) -> Arrays:
        """The tables as named arrays."""
        return {
            "next_id": np.array(self._next_id),
            "points": self._points,
            "anchors": self._anchors,
            "owners": self._owners,
            "covered": self._covered.ravel(),
            "sightings": self._sightings,
            "seen_s": self._seen_s,
            "landmarks": self._landmarks,
        }

    def restore(self, state: Arrays) -> None:
        """Replace the content by a state; those of older versions do not say what covers points.

        Raises ValueError.
        """
        self._next_id = int(state["next_id"])
        self._points, self._anchors = state["points"], state["anchors"]
        self._owners, self._sightings = state["owners"], state["sightings"]
        unknown = np.ones((len(self._owners), 2), np.int64)
        self._covered = state.get("covered", unknown).reshape(-1, 2).copy()
        if self._covered.shape != unknown.shape or (self._covered[:, 1] < 1).any():
            raise ValueError("not how many views show each point of an object")
        if (self._owners < 0).any():
            raise ValueError("points of an object with a negative id")
        self._seen_s, self._landmarks = state["seen_s"], state["landmarks"]
