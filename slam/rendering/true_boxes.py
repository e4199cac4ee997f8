"""Where the objects of a rendered scene really are: a box around each, in its own frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.rendering.engine.builder import SceneBuilder

OBJECTS_TRUTH = "objects_truth.json"


def true_boxes(b: SceneBuilder) -> dict[str, Any]:
    """The content of objects_truth.json: all instances that do not move, in the world frame.

    ``T_world_box`` has its origin in the box's centre and the axes of the object.
    """
    corners: dict[int, list[np.ndarray]] = {}
    for part in b.parts:
        if part.instance:
            corners.setdefault(part.instance, []).append(part.shape.corners.reshape(-1, 3))
    objects = []
    for instance, pieces in sorted(corners.items()):
        T_world_object = b.frames[instance - 1]
        points = transform(inverse(T_world_object), np.concatenate(pieces))
        low, high = points.min(axis=0), points.max(axis=0)
        T_object_box = np.eye(4)
        T_object_box[:3, 3] = (low + high) / 2
        objects.append(
            {
                "instance_id": instance,
                "label": b.categories[instance - 1],
                "T_world_box": (T_world_object @ T_object_box).round(9).tolist(),
                "size_m": (high - low).round(9).tolist(),
            }
        )
    return {"objects": objects}
