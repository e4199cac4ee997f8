"""Ground truth of the objects in a rendered sequence: masks in COCO's format and 3D boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.camera import Camera
from bmask_slam.graph.geometry import inverse, transform
from bmask_slam.rendering.engine.builder import UNLABELLED, SceneBuilder
from bmask_slam.rendering.engine.scene import Scene
from bmask_slam.semantics.instances.run_lengths import run_lengths
from bmask_slam.semantics.labels import read_label_set

CLASSES: tuple[str, ...] = read_label_set("paper").names[1:]
"""Class names of the objects: the 23 of the paper's Table 2, in its order."""
CATEGORY_IDS: dict[str, int] = {name: i for i, name in enumerate(CLASSES, 1)}
"""Category ids of the annotations: places in CLASSES, from 1."""
OBJECTS_TRUTH = "objects_truth.json"
"""The file of ``true_boxes`` in a sequence's folder."""


@dataclass(frozen=True)
class VisibleInstance:
    """The visible pixels of one instance: id, area, box (x, y, width, height), run lengths."""

    instance: int
    area: int
    box: tuple[int, int, int, int]
    counts: list[int]


def visible_instances(instances: NDArray[np.uint16]) -> list[VisibleInstance]:
    """All instances in an image of ids (H, W), 0 for background, by rising id."""
    ids, areas = np.unique(instances, return_counts=True)
    visible = []
    for i, area in zip(ids.tolist(), areas.tolist(), strict=True):
        if i == 0:
            continue
        mask = instances == i
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        x, y = int(columns[0]), int(rows[0])
        box = (x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1)
        visible.append(VisibleInstance(i, area, box, run_lengths(mask)))
    return visible


def coco(
    frames: list[list[VisibleInstance]], stamps: list[str], camera: Camera, scene: Scene
) -> dict[str, Any]:
    """The content of annotations.json: ids count from 1, images are in order of time."""
    images = [
        {"id": k, "file_name": f"rgb/{stamp}.png", "width": camera.width, "height": camera.height}
        for k, stamp in enumerate(stamps, 1)
    ]
    annotations: list[dict[str, Any]] = []
    for k, visible in enumerate(frames, 1):
        for shown in visible:
            if scene.categories[shown.instance - 1] == UNLABELLED:
                continue
            category = CATEGORY_IDS[scene.categories[shown.instance - 1]]
            size = [camera.height, camera.width]
            annotations.append({
                "id": len(annotations) + 1, "image_id": k, "category_id": category,
                "instance_id": shown.instance, "bbox": list(shown.box), "area": shown.area,
                "segmentation": {"size": size, "counts": shown.counts}, "iscrowd": 0,
            })  # fmt: skip
    categories = [{"id": i, "name": name} for name, i in CATEGORY_IDS.items()]
    return {"images": images, "categories": categories, "annotations": annotations}


def true_boxes(b: SceneBuilder) -> dict[str, Any]:
    """The content of OBJECTS_TRUTH: 3D boxes around all static instances, in the world frame.

    ``T_world_box`` has its origin in the box's centre and the axes of the object.
    """
    corners: dict[int, list[Array]] = {}
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
