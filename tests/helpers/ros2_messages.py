"""Messages of ROS 2 for tests: random ones, and what a test asks of those that are received."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from bmask_slam.live.ros2.dds import idl_struct
from bmask_slam.live.ros2.transport import LATCHED, STATE, typestore

HEARD = {
    "/bmask_slam/odometry": ("Odometry", STATE),
    "/bmask_slam/pose": ("PoseWithCovarianceStamped", STATE),
    "/bmask_slam/path": ("Path", LATCHED),
    "/bmask_slam/landmarks": ("PointCloud2", LATCHED),
    "/bmask_slam/map": ("OccupancyGrid", LATCHED),
    "/bmask_slam/cloud": ("PointCloud2", LATCHED),
    "/bmask_slam/objects": ("Detection3DArray", LATCHED),
    "/bmask_slam/object_markers": ("MarkerArray", LATCHED),
    "/diagnostics": ("DiagnosticArray", STATE),
    "/tf": ("TFMessage", STATE),
    "/tf_static": ("TFMessage", LATCHED),
}
"""All topics on which a live run publishes, with type and quality of service."""


def example_message(name: str, rng: np.random.Generator, as_idl: bool = False) -> Any:
    """A message with random values: of rosbags, or of the struct that cyclonedds knows."""
    store = typestore()
    values = {f: _value(kind, rng, as_idl) for f, kind in store.fielddefs[name][1]}
    return (idl_struct(name) if as_idl else store.types[name])(**values)


def _value(kind: Any, rng: np.random.Generator, as_idl: bool) -> Any:
    node, described = kind[0].name, kind[1]
    if node == "NAME":
        return example_message(described, rng, as_idl)
    if node == "BASE":
        base = described[0]
        if base == "string":
            return "abcdefgh"[: int(rng.integers(0, 8))]
        if base == "bool":
            return bool(rng.integers(0, 2))
        lowest = -100 if base.startswith("int") else 0
        is_real = "float" in base
        return float(np.float32(rng.normal())) if is_real else int(rng.integers(lowest, 100))
    count = described[1] if node == "ARRAY" else int(rng.integers(0, 4))
    values = [_value(described[0], rng, as_idl) for _ in range(count)]
    if as_idl or described[0][0].name == "NAME" or described[0][1][0] == "string":
        return values
    return np.array(values, described[0][1][0])


def told(received: Any) -> dict:
    """What a test asks of a message."""
    return _TOLD[type(received).__name__.rpartition("__")[2]](received)


def _pose(received: Any) -> dict:
    """Of Odometry and PoseWithCovarianceStamped."""
    p, q = received.pose.pose.position, received.pose.pose.orientation
    stamp = received.header.stamp
    return {
        "stamp_s": stamp.sec + 1e-9 * stamp.nanosec, "position": [p.x, p.y, p.z],
        "quaternion": [q.x, q.y, q.z, q.w], "frame": received.header.frame_id,
        "child": getattr(received, "child_frame_id", ""),
        "covariance": received.pose.covariance.tolist(),
    }  # fmt: skip


def _transforms(received: Any) -> dict:
    moved = [t.transform.translation for t in received.transforms]
    return {
        "links": [[t.header.frame_id, t.child_frame_id] for t in received.transforms],
        "moved": [[v.x, v.y, v.z] for v in moved],
    }


def _cloud(received: Any) -> dict:
    rows = received.data.view([("xyz", "<f4", 3), ("bgr", "u1", 3), ("pad", "u1")])
    first = {"xyz": rows[0]["xyz"].tolist(), "bgr": rows[0]["bgr"].tolist()} if len(rows) else {}
    names = [f.name for f in received.fields]
    return {"points": received.width, "fields": names, "first": first}


def _grid(received: Any) -> dict:
    info = received.info
    return {
        "size": [info.height, info.width],
        "resolution": info.resolution,
        "origin": [info.origin.position.x, info.origin.position.y, info.origin.position.z],
        "cells": received.data.tolist(),
    }


def _detections(received: Any) -> dict:
    return {
        "objects": [
            {
                "id": one.id,
                "scores": {r.hypothesis.class_id: r.hypothesis.score for r in one.results},
                "size": [one.bbox.size.x, one.bbox.size.y, one.bbox.size.z],
            }
            for one in received.detections
        ]
    }


def _markers(received: Any) -> dict:
    return {"markers": [[m.ns, m.id, m.action, m.text] for m in received.markers]}


_TOLD: dict[str, Callable[[Any], dict]] = {
    "Odometry": _pose,
    "PoseWithCovarianceStamped": _pose,
    "TFMessage": _transforms,
    "PointCloud2": _cloud,
    "OccupancyGrid": _grid,
    "Detection3DArray": _detections,
    "MarkerArray": _markers,
    "DiagnosticArray": lambda received: {"status": received.status[0].message},
    "Path": lambda received: {"poses": len(received.poses)},
}
