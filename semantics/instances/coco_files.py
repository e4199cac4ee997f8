"""COCO annotation files: every object is checked, masks are decoded one at a time."""

from __future__ import annotations

import json
import logging
import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pycocotools import mask as coco_mask

from bmask_slam.graph.arrays import Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.semantics.labels import LabelSet, label_set

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class CocoObject:
    """One annotated object.

    Attributes:
        label: class in the file's label set.
        runs: the mask as compressed run lengths.
        box: x1, y1, x2, y2 in pixels.
        crowd: whether it stands for a group of objects.
        score, class_score: of a result file; 1 in an annotation file.
        distribution: over classes, in a result file that has it.
    """

    label: int
    runs: dict[str, Any]
    box: tuple[float, float, float, float]
    crowd: bool
    score: float = 1.0
    class_score: float = 1.0
    distribution: tuple[float, ...] | None = None

    def mask(self) -> Mask:
        """The mask (H, W) bool."""
        return np.asarray(coco_mask.decode(self.runs), bool)


@dataclass(frozen=True)
class CocoImage:
    """One image and its objects."""

    number: int
    file_name: str
    height: int
    width: int
    objects: tuple[CocoObject, ...]


@dataclass(frozen=True)
class CocoFile:
    """The images of a file, in its order.

    Attributes:
        labels: the categories, sorted by id, as labels 1, 2, ...
        category_ids: the file's id of each label, with 0 for the background.
        problems: one line for each object, or part of one, that is not used, with the reason.
    """

    labels: LabelSet
    category_ids: tuple[int, ...]
    images: tuple[CocoImage, ...]
    problems: tuple[str, ...]


def read_coco(path: Path) -> CocoFile:
    """Read a file; invalid objects are skipped with a warning.

    Raises:
        InputError: not JSON, not in COCO's format, or without images.
    """
    content = _read_json(path)
    try:
        categories = sorted((int(c["id"]), str(c["name"])) for c in content["categories"])
        sizes = {
            int(i["id"]): (str(i["file_name"]), int(i["height"]), int(i["width"]))
            for i in content["images"]
        }
        annotations = list(content["annotations"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: not in COCO's format ({error!r}); it needs images, annotations, categories"
        ) from error
    if not sizes:
        raise InputError(f"{path}: there is no image in it; give another file")
    labels = {number: k for k, (number, _) in enumerate(categories, 1)}
    objects: dict[int, list[CocoObject]] = defaultdict(list)
    problems: list[str] = []
    for annotation in annotations:
        try:
            image = sizes[_integer(annotation, "image_id", sizes)]
            label = labels[_integer(annotation, "category_id", labels)]
            objects[annotation["image_id"]].append(_read_object(annotation, image, label, problems))
        except ValueError as error:
            problems.append(f"annotation {_name(annotation)}: {error}; left out")
    if problems:
        logger.warning("%s: %d problems, the first: %s", path, len(problems), problems[0])
    images = [CocoImage(k, *size, tuple(objects[k])) for k, size in sizes.items()]
    names = label_set([name for _, name in categories])
    return CocoFile(names, (0, *(k for k, _ in categories)), tuple(images), tuple(problems))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a COCO file") from error
    except ValueError as error:
        raise InputError(f"{path}: not JSON ({error}); give a COCO file") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: not in COCO's format, but a {type(content).__name__}")
    return content


def _name(annotation: object) -> str:
    return str(annotation.get("id", "?")) if isinstance(annotation, dict) else "?"


def _integer(annotation: Any, key: str, known: dict[int, Any]) -> int:
    """The id under ``key``, which must be known."""
    if not isinstance(annotation, dict) or annotation.get(key) not in known:
        found = annotation.get(key) if isinstance(annotation, dict) else annotation
        raise ValueError(f"{key} {found!r} is not in the file")
    return int(annotation[key])


def _read_object(
    annotation: dict[str, Any], image: tuple[str, int, int], label: int, problems: list[str]
) -> CocoObject:
    """One object. Raises ValueError with the reason if it is invalid."""
    _, height, width = image
    segmentation = annotation.get("segmentation")
    if isinstance(segmentation, dict):
        runs = _run_lengths(segmentation, height, width)
    elif isinstance(segmentation, list):
        good = [p for p in segmentation if _is_polygon(p)]
        if len(good) < len(segmentation):
            bad = len(segmentation) - len(good)
            problems.append(f"annotation {_name(annotation)}: {bad} invalid polygons left out")
        if not good:
            raise ValueError("no valid polygon")
        runs = coco_mask.merge(coco_mask.frPyObjects(good, height, width))
    else:
        raise ValueError("no segmentation")
    if int(coco_mask.area(runs)) == 0:
        raise ValueError("the mask is empty")
    x, y, w, h = (float(v) for v in coco_mask.toBbox(runs))
    distribution = annotation.get("distribution")
    return CocoObject(
        label,
        runs,
        (x, y, x + w, y + h),
        bool(annotation.get("iscrowd", 0)),
        float(annotation.get("score", 1.0)),
        float(annotation.get("class_score", annotation.get("score", 1.0))),
        None if distribution is None else tuple(float(p) for p in distribution),
    )


def _is_polygon(points: object) -> bool:
    """At least three points as a flat list of finite x, y."""
    return (
        isinstance(points, list)
        and len(points) >= 6
        and len(points) % 2 == 0
        and all(isinstance(v, (int, float)) and math.isfinite(v) for v in points)
    )


def _run_lengths(segmentation: dict[str, Any], height: int, width: int) -> dict[str, Any]:
    """Compressed run lengths from compressed or plain ones."""
    if segmentation.get("size") != [height, width]:
        raise ValueError(f"a mask of size {segmentation.get('size')} in {[height, width]}")
    counts = segmentation.get("counts")
    if isinstance(counts, list):
        if sum(counts) != height * width or min(counts, default=0) < 0:
            raise ValueError(f"run lengths that do not add up to {height * width} pixels")
        return dict(coco_mask.frPyObjects(segmentation, height, width))
    if not isinstance(counts, str):
        raise ValueError("no run lengths")
    return {"size": [height, width], "counts": counts.encode()}
