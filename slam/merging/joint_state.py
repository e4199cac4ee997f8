"""The states of several systems as one: their maps side by side, with ids that differ.

Every run's map segments stay what they are, each in a world frame of its own, until they are moved.
Ids of a run are shifted by those of the runs before it, so that the first run keeps its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array, Arrays, Ints
from bmask_slam.graph.factors.graph_update import (
    ANCHOR,
    FIRST_FRAME,
    FRAMES_OF_A_KIND,
    MARGINAL,
    MARKER,
    MARKERS_OF_A_SEGMENT,
    PosePrior,
    marker_id,
    site_id,
)
from bmask_slam.graph.files.array_file import part
from bmask_slam.labelling.label_views import FIRST_LABEL_VIEW
from bmask_slam.sensing.reference_frame import RETIRED_FRAME
from bmask_slam.sensing.sensor_fusion import KINDS

_MADE_BY_GRAPH = (PosePrior.kind, ANCHOR, MARGINAL)
"""Kinds of factors that a graph makes anew."""


@dataclass(frozen=True)
class Shift:
    """What is added to the ids, frame indices and stamps of one run.

    Attributes:
        keyframes, landmarks, segments, objects, label_views: to ids.
        frames: to indices in the recording.
        stamp_s: to stamps, in whole seconds.
    """

    keyframes: int = 0
    landmarks: int = 0
    segments: int = 0
    objects: int = 0
    frames: int = 0
    stamp_s: float = 0.0
    label_views: int = 0

    def keyframe(self, ids: Ints) -> Ints:
        """Ids of keyframes and numbers of label views; -1 stays."""
        added = np.where(ids < FIRST_LABEL_VIEW, self.keyframes, self.label_views)
        return np.where(ids >= 0, ids + added, ids)

    def landmark(self, ids: Ints) -> Ints:
        """Ids of landmarks; -1 stays."""
        return np.where(ids >= 0, ids + self.landmarks, ids)

    def segment(self, ids: Ints) -> Ints:
        """Numbers of map segments."""
        return ids + self.segments

    def object(self, ids: Ints) -> Ints:
        """Ids of objects."""
        return ids + self.objects

    def frame(self, indices: Ints) -> Ints:
        """Indices of frames."""
        return indices + self.frames

    def stamp(self, stamps_s: Array) -> Array:
        """Stamps in seconds."""
        return stamps_s + self.stamp_s

    def pose(self, ids: Ints) -> Ints:
        """Ids of poses in the graph: keyframes, reference frames and markers of segments."""
        of_markers = (ids >= marker_id(0, 0)) & (ids < site_id(0))
        segments = self.segments * np.where(of_markers, MARKERS_OF_A_SEGMENT, 1)
        return np.where(ids < FIRST_FRAME, ids + self.keyframes, ids + segments)

    def after(self, state: Arrays, frames: int, stamp_s: float) -> Shift:
        """The shift of the next run, after one with this shift and state.

        ``frames`` and ``stamp_s`` are those of the next run.
        """
        frame_ids = state["mapper.graph.keyframe_ids"]
        retired = (frame_ids >= RETIRED_FRAME) & (frame_ids < marker_id(0, 0))
        frame_ids = frame_ids[retired] % FRAMES_OF_A_KIND
        past = frame_ids - RETIRED_FRAME % FRAMES_OF_A_KIND
        numbers = np.concatenate([state["mapper.world.keyframes.segment"], past])
        return Shift(
            self.keyframes + int(state["mapper.world.next_keyframe_id"]),
            self.landmarks + int(state["mapper.world.landmarks.size"]),
            self.segments + int(numbers.max(initial=0)) + 1,
            self.objects + int(state["semantics.objects.points.next_id"]),
            frames,
            stamp_s,
            self.label_views + int(state["mapper.world.label_views"]),
        )


_Change = Callable[[Shift, Any], Any]


def _pairs(first: str, second: str) -> _Change:
    """Of rows (N, 2) of two kinds of ids."""

    def change(shift: Shift, rows: Array) -> Array:
        columns = (getattr(shift, first)(rows[:, 0]), getattr(shift, second)(rows[:, 1]))
        return np.stack(columns, axis=1)

    return change


def _evidence(shift: Shift, flat: Array) -> Array:
    """Of rows of two objects and a count, flattened."""
    more = np.array([shift.objects, shift.objects, 0], np.int64)
    return np.asarray((flat.reshape(-1, 3) + more).ravel())


_WORLD, _HISTORY, _OBJECTS = "mapper.world.", "mapper.history.", "semantics.objects."
_KEYFRAMES = (
    *(f"{_WORLD}{name}" for name in ("keyframes.id", "culled.id")),
    *(f"{_WORLD}landmarks.{name}" for name in ("host", "last_keyframe")),
    *(f"{_HISTORY}{name}" for name in ("keyframe_ids", "culled_ids", "heir_ids")),
    *(f"semantics.{name}" for name in ("done", "waiting", "votes.keyframes", "upright.keyframes")),
    *("semantics.views.numbers", "semantics.views.parents"),
    *("semantics.objects.points.anchors", "mapper.loops.closed"),
)
_LANDMARKS = (
    *(f"{_WORLD}{name}" for name in ("landmarks.ids", "culled.landmark_ids")),
    *(f"{_WORLD}keypoints.{name}" for name in ("landmark_ids", "sent_ids")),
    *("semantics.labels.ids", "semantics.surfaces.ids", "dynamics.movability.ids"),
    "semantics.views.landmark_ids",
)
_CHANGES: dict[str, _Change] = {
    **dict.fromkeys(_KEYFRAMES, Shift.keyframe),
    **dict.fromkeys(_LANDMARKS, Shift.landmark),
    **dict.fromkeys((f"{_OBJECTS}labels.ids", f"{_OBJECTS}points.owners"), Shift.object),
    f"{_WORLD}keyframes.segment": Shift.segment,
    f"{_WORLD}keyframes.frame_index": Shift.frame,
    **dict.fromkeys(
        (
            *(f"{_WORLD}keyframes.timestamp_s", f"{_HISTORY}timestamps_s"),
            *("semantics.waiting_s", "semantics.views.stamps_s", f"{_OBJECTS}points.seen_s"),
        ),
        Shift.stamp,
    ),
    f"{_OBJECTS}points.sightings": _pairs("object", "keyframe"),
    f"{_OBJECTS}points.landmarks": _pairs("landmark", "object"),
    **dict.fromkeys((f"{_OBJECTS}merging", f"{_OBJECTS}splitting"), _evidence),
}
"""What is done to the arrays of a run that hold ids, indices or stamps; others stay as they are."""
_SUMS = (
    *(f"{_WORLD}{name}" for name in ("next_keyframe_id", "label_views", "landmarks.size")),
    f"{_OBJECTS}points.next_id",
)
_COMMON = ("semantics.names", "semantics.measured", "semantics.surfaces.names")
_SIZE, _CODED = "dynamics.movability.size", "semantics.votes.coded"
_PARTS = (_WORLD, _HISTORY, "mapper.loops.closed", "mapper.loops.believed", "dynamics.movability.")


def joint_state(states: Sequence[Arrays], shifts: Sequence[Shift], empty: Arrays) -> Arrays:
    """The state of a system that has the maps of several, of which ``empty`` has none.

    Semantics are those of the runs with a segmenter, which have one label set. What only serves to
    track on (the last frames, moving objects, waiting loops) begins anew.
    """
    found = dict(empty)
    for name in states[0]:
        if name.startswith(_PARTS):
            found[name] = _joined(name, states, shifts)
    labelled = [k for k, s in enumerate(states) if len(s["semantics.names"]) > 1]
    if labelled:
        those = [states[k] for k in labelled]
        for name in (n for n in those[0] if n.startswith("semantics.")):
            if not all(name in state for state in those):  # of an older version
                found.pop(name, None)
                continue
            found[name] = _joined(name, those, [shifts[k] for k in labelled])
    found |= _graph(states, shifts) | _sensors(states, shifts)
    return found


def _joined(name: str, states: Sequence[Arrays], shifts: Sequence[Shift]) -> Array:
    """One array of all runs, one after the other."""
    arrays = [state[name] for state in states]
    if name in _SUMS:
        return np.asarray(sum(arrays))
    if name == _SIZE:
        return np.asarray(sum(state[f"{_WORLD}landmarks.size"] for state in states))
    if name in _COMMON:
        return max(arrays, key=len)
    if name == _CODED:  # rows of another table
        counts = [len(state["semantics.votes.keyframes"]) for state in states]
        before = np.cumsum([0, *counts[:-1]])
        return np.concatenate([a + n for a, n in zip(arrays, before, strict=True)])
    change = _CHANGES.get(name, lambda shift, array: array)
    return np.concatenate([change(shift, a) for shift, a in zip(shifts, arrays, strict=True)])


def _graph(states: Sequence[Arrays], shifts: Sequence[Shift]) -> Arrays:
    """What a graph that is built anew takes over from others: all but observations.

    Users' factors only of the first run, since they are code or name its ids.
    """
    graphs = [part(state, "mapper.graph") for state in states]
    found: Arrays = {"landmark_ids": graphs[0]["landmark_ids"]}
    found["points_world"] = graphs[0]["points_world"]
    found |= {n: a for n, a in graphs[0].items() if n.startswith("own_")}
    ids = np.concatenate([s.pose(g["keyframe_ids"]) for s, g in zip(shifts, graphs, strict=True)])
    order = np.argsort(ids)
    found["keyframe_ids"] = ids[order]
    found["poses_world_camera"] = np.concatenate([g["poses_world_camera"] for g in graphs])[order]
    kept = [~np.isin(g["pose_factor_kinds"], _MADE_BY_GRAPH) for g in graphs]
    for name in (n for n in graphs[0] if n.startswith("pose_factor_")):
        rows = [g[name][k] for g, k in zip(graphs, kept, strict=True)]
        if name == "pose_factor_keyframes":
            rows = [s.pose(r) for s, r in zip(shifts, rows, strict=True)]
        found[name] = np.concatenate(rows)
    found["pose_factor_chunks"][:] = -1
    return {f"mapper.graph.{n}": a for n, a in (found | _inertial(graphs, shifts)).items()}


def _inertial(graphs: Sequence[Arrays], shifts: Sequence[Shift]) -> Arrays:
    """The inertial parts of graphs; nothing if none has one."""
    having = [(g, s) for g, s in zip(graphs, shifts, strict=True) if "imu_factors" in g]
    found: dict[str, list[Array]] = {}
    for graph, s in having:
        added = {"imu_factors": [s.keyframes, s.keyframes, s.segments, 0]}
        added |= {"imu_keyframes": [s.keyframes], "imu_segments": [s.segments]}
        for name in (n for n in graph if n.startswith("imu_")):
            more = np.array(added[name], np.int64) if name in added else graph[name].dtype.type(0)
            found.setdefault(name, []).append(graph[name] + more)
    return {name: np.concatenate(arrays) for name, arrays in found.items()}


def _sensors(states: Sequence[Arrays], shifts: Sequence[Shift]) -> Arrays:
    """Which factors of sensors there are, and what was found of markers' sizes.

    Their measurements are gone, as in another session.
    """
    having = [state for state in states if "mapper.sensors.made" in state]
    made = [
        np.c_[state["mapper.sensors.made"][:, :1], s.pose(state["mapper.sensors.made"][:, 1:])]
        for state, s in zip(states, shifts, strict=True)
        if "mapper.sensors.made" in state
    ]
    if not made:
        return {}
    following = shifts[-1].keyframes + int(states[-1]["mapper.world.next_keyframe_id"])
    found: Arrays = {"first_keyframe": np.array(following), "made": np.concatenate(made)}
    found["made_s"] = np.concatenate([_verdicts(state) for state in having])
    sizes = np.concatenate([state["mapper.sensors.marker_sizes"] for state in having])
    numbers, of = np.unique(sizes[:, 0], return_inverse=True)
    found["marker_sizes"] = np.zeros((len(numbers), 3))
    np.add.at(found["marker_sizes"], of, sizes * [0.0, 1.0, 1.0])
    found["marker_sizes"][:, 0] = numbers
    return {f"mapper.sensors.{name}": array for name, array in found.items()}


def _verdicts(state: Arrays) -> Array:
    """Of each factor NaN, or why a marker's sighting is none; stamps of positions are left out."""
    kinds = state["mapper.sensors.made"][:, 0]
    is_sighting = kinds == KINDS.index(MARKER)
    return np.where(is_sighting, state["mapper.sensors.made_s"], np.nan)
