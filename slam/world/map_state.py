"""The map as named arrays and back: the arrays of all keyframes are concatenated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from bmask_slam.features.brisk import Features
from bmask_slam.graph.arrays import Arrays
from bmask_slam.graph.files.array_file import check_ids, nested, part, split_rows
from bmask_slam.graph.files.disk_arrays import concatenated
from bmask_slam.world.keyframe import CulledKeyframe, Keyframe
from bmask_slam.world.landmark_table import LandmarkTable
from bmask_slam.world.world_map import WorldMap

MAX_LABEL_VIEWS = 10**9
"""No map has more: one in 0.2 s, for six years."""
_Columns = dict[str, tuple[tuple[int, ...], type]]  # shape of a row, and its type
_KEYFRAME: _Columns = {
    "id": ((), np.int64),
    "frame_index": ((), np.int64),
    "timestamp_s": ((), np.float64),
    "segment": ((), np.int64),
    "T_world_camera": ((4, 4), np.float64),
}
_KEYPOINT: _Columns = {
    "landmark_ids": ((), np.int64),
    "sent_ids": ((), np.int64),
    "masked": ((), np.bool_),
}
_FEATURE: _Columns = {
    "pixels": ((2,), np.float64),
    "image_pixels": ((2,), np.float64),
    "descriptors": ((8,), np.uint64),
    "scales": ((), np.float64),
    "angles_rad": ((), np.float64),
    "depth_m": ((), np.float64),
    "disparity_px": ((), np.float64),
    "sigmas_px": ((3,), np.float64),
    "colours": ((3,), np.uint8),
}  # features of a keyframe have no image
_CULLED: _Columns = {"image_pixels": ((2,), np.float64), "landmark_ids": ((), np.int64)}


def world_state(world: WorldMap) -> Arrays:
    """The whole map as named arrays."""
    keyframes = list(world.keyframes.values())
    features = [keyframe.features for keyframe in keyframes]
    rows: Arrays = {
        name: np.array([getattr(k, name) for k in keyframes], dtype).reshape(-1, *shape)
        for name, (shape, dtype) in _KEYFRAME.items()
    }
    rows["keypoints"] = np.array([len(f) for f in features], np.int64)
    return {
        "next_keyframe_id": np.array(world.next_keyframe_id),
        "label_views": np.array(world.label_views),
        **nested(
            landmarks=world.landmarks.state(),
            keyframes=rows,
            keypoints=_joined(keyframes, _KEYPOINT) | _joined(features, _FEATURE),
            culled=_culled_state(world.culled),
        ),
    }


def world_of(state: Arrays) -> WorldMap:
    """The map of a ``world_state``."""
    rows, keypoints = part(state, "keyframes"), part(state, "keypoints")
    pieces = {name: split_rows(array, rows["keypoints"]) for name, array in keypoints.items()}
    keyframes = {}
    for row, keyframe_id in enumerate(rows["id"].tolist()):
        own = {name: pieces[name][row].copy() for name in pieces}
        image = np.zeros((0, 0), np.uint8)
        keyframe = Keyframe(
            id=keyframe_id,
            frame_index=int(rows["frame_index"][row]),
            timestamp_s=float(rows["timestamp_s"][row]),
            segment=int(rows["segment"][row]),
            T_world_camera=rows["T_world_camera"][row],
            features=Features(**{name: own[name] for name in _FEATURE}, gray=image),
            landmark_ids=own["landmark_ids"],
        )
        keyframe.sent_ids, keyframe.masked = own["sent_ids"], own["masked"]
        keyframes[keyframe_id] = keyframe
    check_ids(rows["id"], int(state["next_keyframe_id"]))
    landmarks = LandmarkTable()
    landmarks.restore(part(state, "landmarks"))
    if keypoints["landmark_ids"].max(initial=-1) >= len(landmarks.host):
        raise ValueError("a keypoint on a landmark that is not there")
    culled = _culled_of(part(state, "culled"))
    label_views = int(state.get("label_views", 0))
    if not 0 <= label_views <= MAX_LABEL_VIEWS:
        raise ValueError(f"{label_views} label views")
    world = WorldMap(keyframes, landmarks, int(state["next_keyframe_id"]), culled, label_views)
    for keyframe in keyframes.values():
        world.store_features(keyframe)
    return world


def _culled_state(culled: dict[int, CulledKeyframe]) -> Arrays:
    views = list(culled.values())
    sizes = np.array([len(view.landmark_ids) for view in views], np.int64)
    return {"id": np.array(list(culled), np.int64), "size": sizes, **_joined(views, _CULLED)}


def _culled_of(state: Arrays) -> dict[int, CulledKeyframe]:
    pieces = (split_rows(state[name], state["size"]) for name in _CULLED)
    return dict(zip(state["id"].tolist(), map(CulledKeyframe, *pieces), strict=True))


def _joined(objects: Sequence[Any], columns: _Columns) -> Arrays:
    """Each column of several objects, one after the other; typed where there are none."""
    found: Arrays = {}
    for name, (shape, dtype) in columns.items():
        pieces = [getattr(o, name) for o in objects]
        found[name] = concatenated(pieces, sum(map(len, pieces)), np.zeros((0, *shape), dtype))
    return found
