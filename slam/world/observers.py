"""Which keyframes observe each landmark: an index that answers as fast in a map of any size."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Ints

_NONE = -1


class Observers:
    """The observations of all landmarks, as one linked list a landmark, in arrays.

    Entries are int32: a keyframe and the next entry of the same landmark. A question or a change
    walks all lists that it concerns side by side, so it takes as many steps as the longest list.
    """

    def __init__(self) -> None:
        self._first = np.zeros(0, np.int32)  # entry of each landmark id
        self._keyframe = np.zeros(0, np.int32)
        self._next = np.zeros(0, np.int32)
        self._free = np.zeros(0, np.int32)  # a stack of free entries ...
        self._free_count = 0  # ... and how many of its elements are valid

    def add(self, keyframe_id: int, landmark_ids: Ints) -> None:
        """A keyframe observes landmarks (N,); one that is given twice it observes twice."""
        ids = np.sort(landmark_ids)
        self._make_room(len(ids), int(ids[-1]) + 1 if len(ids) else 0)
        self._free_count -= len(ids)
        entries = self._free[self._free_count : self._free_count + len(ids)].copy()
        self._keyframe[entries] = keyframe_id
        self._next[entries] = self._first[ids]
        same = np.flatnonzero(ids[1:] == ids[:-1])
        self._next[entries[same]] = entries[same + 1]
        begins = np.ones(len(ids), bool)
        begins[same + 1] = False
        self._first[ids[begins]] = entries[begins]

    def remove(self, keyframe_id: int, landmark_ids: Ints) -> None:
        """A keyframe observes landmarks (N,) no more, or once less each time that one is given.

        Raises KeyError for one that it does not observe.
        """
        ids, counts = np.unique(landmark_ids, return_counts=True)
        while len(ids):
            self._remove_once(keyframe_id, ids)
            counts = counts - 1
            ids, counts = ids[counts > 0], counts[counts > 0]

    def of(self, landmark_ids: Ints) -> Ints:
        """The keyframe of each observation (E,) of landmarks (N,), which are given once each."""
        entries = self._first[landmark_ids[landmark_ids < len(self._first)]]
        found = [np.zeros(0, np.int32)]
        while len(entries := entries[entries >= 0]):
            found.append(self._keyframe[entries])
            entries = self._next[entries]
        return np.concatenate(found).astype(np.int64)

    def _remove_once(self, keyframe_id: int, ids: Ints) -> None:
        before = np.full(len(ids), _NONE, np.int32)
        entries = self._first[ids]
        while len(ids):
            if (entries < 0).any():
                raise KeyError(f"keyframe {keyframe_id} does not observe {ids[entries < 0]}")
            found = self._keyframe[entries] == keyframe_id
            gone, after = entries[found], self._next[entries[found]]
            heads = before[found] == _NONE
            self._first[ids[found][heads]] = after[heads]
            self._next[before[found][~heads]] = after[~heads]
            self._free[self._free_count : self._free_count + len(gone)] = gone
            self._free_count += len(gone)
            ids, before = ids[~found], entries[~found]
            entries = self._next[before]

    def _make_room(self, entries: int, landmarks: int) -> None:
        if landmarks > (known := len(self._first)):
            more = max(landmarks - known, known, 1024)
            self._first = np.append(self._first, np.full(more, _NONE, np.int32))
        if entries > self._free_count:
            capacity = len(self._keyframe)
            more = max(entries, capacity // 2, 4096)
            self._keyframe = np.append(self._keyframe, np.zeros(more, np.int32))
            self._next = np.append(self._next, np.full(more, _NONE, np.int32))
            unused = np.arange(capacity, capacity + more, dtype=np.int32)
            self._free = np.append(self._free[: self._free_count], unused)
            self._free = np.append(self._free, np.zeros(capacity, np.int32))
            self._free_count += more
