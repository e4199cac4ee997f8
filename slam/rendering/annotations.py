"""Instance annotations of a rendered sequence in COCO's format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.camera import Camera
from bmask_slam.rendering.classes import CATEGORY_IDS
from bmask_slam.rendering.engine.builder import UNLABELLED
from bmask_slam.rendering.engine.scene import Scene


@dataclass(frozen=True)
class Mark:
    """The visible pixels of one instance: id, area, box (x, y, width, height), run lengths."""

    instance: int
    area: int
    box: tuple[int, int, int, int]
    counts: list[int]


FrameMarks = list[Mark]


def frame_marks(instances: NDArray[np.uint16]) -> FrameMarks:
    """All instances in a picture of ids (H, W), 0 for background, by rising id."""
    ids, areas = np.unique(instances, return_counts=True)
    marks = []
    for i, area in zip(ids.tolist(), areas.tolist(), strict=True):
        if i == 0:
            continue
        mask = instances == i
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        x, y = int(columns[0]), int(rows[0])
        box = (x, y, int(columns[-1]) - x + 1, int(rows[-1]) - y + 1)
        marks.append(Mark(i, area, box, run_lengths(mask)))
    return marks


def run_lengths(mask: Mask) -> list[int]:
    """COCO's uncompressed run lengths: columns one after the other, zeros first."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.r_[changes, flat.size]
    starts = np.r_[0, changes]
    counts = (ends - starts).tolist()
    return [0, *counts] if flat[0] else counts


def coco(
    frames: list[FrameMarks], stamps: list[str], camera: Camera, scene: Scene
) -> dict[str, Any]:
    """The content of annotations.json; image ids count from 1 in order of time."""
    images = [
        {"id": k, "file_name": f"rgb/{stamp}.png", "width": camera.width, "height": camera.height}
        for k, stamp in enumerate(stamps, 1)
    ]
    annotations: list[dict[str, Any]] = []
    for k, marks in enumerate(frames, 1):
        for mark in marks:
            if scene.categories[mark.instance - 1] == UNLABELLED:
                continue
            category = CATEGORY_IDS[scene.categories[mark.instance - 1]]
            size = [camera.height, camera.width]
            annotations.append({
                "id": len(annotations) + 1, "image_id": k, "category_id": category,
                "instance_id": mark.instance, "bbox": list(mark.box), "area": mark.area,
                "segmentation": {"size": size, "counts": mark.counts}, "iscrowd": 0,
            })  # fmt: skip
    categories = [{"id": i, "name": name} for name, i in CATEGORY_IDS.items()]
    return {"images": images, "categories": categories, "annotations": annotations}
