"""Objects of the map as ROS 2's markers, and as detections with the probabilities of labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.labelling.results import MapObjects
from bmask_slam.live.ros2.messages import header, message, pose
from bmask_slam.run_folder.object_picture import distinct_colour
from bmask_slam.semantics.objects.publication import MapObject

MIN_PROBABILITY, MAX_LABELS = 0.01, 10
"""Of the labels of a detection."""
_CUBE, _TEXT, _ADD, _DELETE_ALL = 1, 9, 0, 3
ALPHA, TEXT_M = 0.4, 0.1


def marker_array(stamp_s: float, frame: str, found: MapObjects, T_frame_world: Array) -> Any:
    """A visualization_msgs/MarkerArray: a box and its label for each object, in their colours."""
    markers = [_marker(stamp_s, frame, _DELETE_ALL)]
    for one in found.objects:
        T = T_frame_world @ one.box.T_world_box
        colour = message("ColorRGBA", *distinct_colour(one.id), ALPHA)
        size = message("Vector3", *map(float, one.box.size_m))
        box = _marker(stamp_s, frame, _ADD)
        box.ns, box.id, box.type = "objects", one.id, _CUBE
        box.pose, box.scale, box.color = pose(T), size, colour
        label = _marker(stamp_s, frame, _ADD)
        label.ns, label.id, label.type = "labels", one.id, _TEXT
        above = T.copy()
        above[:3, 3] += T[:3, 2] * (one.box.size_m[2] / 2 + TEXT_M)
        label.pose, label.scale.z = pose(above), TEXT_M
        label.color = message("ColorRGBA", 1.0, 1.0, 1.0, 1.0)
        label.text = f"{found.names.names[one.label]} {one.distribution[one.label]:.2f}"
        markers += [box, label]
    return message("MarkerArray", markers)


def _marker(stamp_s: float, frame: str, action: int) -> Any:
    """A visualization_msgs/Marker without content."""
    still, nothing = message("Duration", 0, 0), np.zeros(0, np.uint8)
    scale, colour = message("Vector3", 0.0, 0.0, 0.0), message("ColorRGBA", 0.0, 0.0, 0.0, 0.0)
    texture = message("CompressedImage", header(0.0, ""), "", nothing)
    mesh = message("MeshFile", "", nothing)
    return message(
        "Marker", header(stamp_s, frame), "", 0, 0, action, pose(np.eye(4)), scale, colour, still,
        False, [], [], "", texture, [], "", "", mesh, False,
    )  # fmt: skip


def detection_array(stamp_s: float, frame: str, found: MapObjects, T_frame_world: Array) -> Any:
    """A vision_msgs/Detection3DArray: boxes, and the likeliest labels with their probabilities."""
    top = header(stamp_s, frame)
    detections = [
        _detection(top, one, found, T_frame_world @ one.box.T_world_box) for one in found.objects
    ]
    return message("Detection3DArray", top, detections)


def _detection(top: Any, one: MapObject, found: MapObjects, T_frame_box: Array) -> Any:
    where = pose(T_frame_box)
    known = message("PoseWithCovariance", where, np.zeros(36))
    likely = np.argsort(-one.distribution, kind="stable")[:MAX_LABELS].tolist()
    results = [
        message(
            "ObjectHypothesisWithPose",
            message("ObjectHypothesis", found.names.names[k], float(one.distribution[k])),
            known,
        )
        for k in likely
        if one.distribution[k] >= MIN_PROBABILITY
    ]
    size = message("Vector3", *map(float, one.box.size_m))
    return message("Detection3D", top, results, message("BoundingBox3D", where, size), str(one.id))
