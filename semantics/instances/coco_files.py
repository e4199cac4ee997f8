"""COCO annotation files: every value is checked before pycocotools gets it, which checks nothing.

Masks are decoded one at a time.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from bmask_slam.graph.arrays import Array, Ints, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import check_name
from bmask_slam.graph.files.json_file import STRICT, Name, first_problem, read_json
from bmask_slam.semantics.labels import LabelSet, label_set

logger = logging.getLogger(__name__)

CURE = "give a COCO file with images, annotations and categories"
MAX_SIDE = 65_535
MAX_PIXELS = 100_000_000
MAX_CORNERS = 100_000
"""Of a polygon."""
MAX_PERIMETER_PX = 10_000_000
"""Of a polygon: pycocotools takes memory for each pixel on its edges, also outside the image."""
Id = Annotated[int, Field(ge=-(2**53), le=2**53)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Probability = Annotated[float, Field(ge=0, le=1 + 1e-6)]


class _Category(BaseModel):
    model_config = STRICT
    id: Id
    name: Name


class _Image(BaseModel):
    model_config = STRICT
    id: Id
    file_name: str
    height: Side
    width: Side


class _RunLengths(BaseModel):
    model_config = STRICT
    size: Annotated[list[Side], Field(min_length=2, max_length=2)]
    counts: str | list[Annotated[int, Field(ge=0, le=MAX_PIXELS)]]


class _Annotation(BaseModel):
    model_config = STRICT
    image_id: Id
    category_id: Id
    segmentation: _RunLengths | list[Any] | None = None
    iscrowd: bool | int = 0
    score: Probability = 1.0
    class_score: Probability | None = None
    distribution: Annotated[list[Probability], Field(max_length=100_000)] | None = None


class _File(BaseModel):
    model_config = STRICT
    images: list[_Image]
    categories: list[_Category]
    annotations: list[Any]


_POLYGON = TypeAdapter(
    Annotated[list[float], Field(min_length=6, max_length=2 * MAX_CORNERS)], config=STRICT
)


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
        InputError: not JSON, not in COCO's format, without images, or with an image whose name
            leads out of the folder or whose size is impossible.
    """
    content = read_json(path, _File, CURE)
    images = _checked_images(content.images, path)
    categories = sorted((c.id, c.name) for c in content.categories)
    labels = {number: k for k, (number, _) in enumerate(categories, 1)}
    objects: dict[int, list[CocoObject]] = defaultdict(list)
    problems: list[str] = []
    for raw in content.annotations:
        try:
            annotation = _checked(raw, images, labels)
            image, label = images[annotation.image_id], labels[annotation.category_id]
            runs = _encoded(annotation, image, f"annotation {_name(raw)}", problems)
            objects[image.id].append(_object(annotation, label, runs))
        except ValueError as error:
            problems.append(f"annotation {_name(raw)}: {error}; left out")
    if problems:
        logger.warning("%s: %d problems, the first: %s", path, len(problems), problems[0])
    return CocoFile(
        label_set([name for _, name in categories]),
        (0, *(number for number, _ in categories)),
        tuple(
            CocoImage(image.id, image.file_name, image.height, image.width, tuple(objects[k]))
            for k, image in images.items()
        ),
        tuple(problems),
    )


def _checked_images(listed: list[_Image], path: Path) -> dict[int, _Image]:
    """The images by id. Raises InputError."""
    if not listed:
        raise InputError(f"{path}: there is no image in it; give another file")
    for image in listed:
        check_name(image.file_name, f"{path}: image {image.id}")
        if image.height * image.width > MAX_PIXELS:
            raise InputError(
                f"{path}: image {image.id} has {image.width} x {image.height} pixels, more than "
                f"{MAX_PIXELS // 10**6} megapixels; correct its size"
            )
    return {image.id: image for image in listed}


def _name(annotation: object) -> str:
    return repr(annotation.get("id", "?"))[:40] if isinstance(annotation, dict) else "?"


def _checked(raw: Any, images: dict[int, _Image], labels: dict[int, int]) -> _Annotation:
    """An annotation of an image and a category of the file. Raises ValueError."""
    try:
        annotation = _Annotation.model_validate(raw)
    except ValidationError as error:
        raise ValueError(first_problem(error)) from error
    if annotation.image_id not in images:
        raise ValueError(f"image_id {annotation.image_id} is not in the file")
    if annotation.category_id not in labels:
        raise ValueError(f"category_id {annotation.category_id} is not in the file")
    return annotation


def _object(annotation: _Annotation, label: int, runs: dict[str, Any]) -> CocoObject:
    x, y, w, h = (float(v) for v in coco_mask.toBbox(runs))
    score, distribution = annotation.score, annotation.distribution
    return CocoObject(
        label,
        runs,
        (x, y, x + w, y + h),
        bool(annotation.iscrowd),
        score,
        score if annotation.class_score is None else annotation.class_score,
        None if distribution is None else tuple(distribution),
    )


def _encoded(
    annotation: _Annotation, image: _Image, where: str, problems: list[str]
) -> dict[str, Any]:
    """The mask as compressed run lengths. Raises ValueError with the reason if it is invalid."""
    given = annotation.segmentation
    if given is None:
        raise ValueError("no segmentation")
    if isinstance(given, _RunLengths):
        runs = _run_lengths(given, image)
    else:
        polygons = [_polygon(points) for points in given]
        good = [points for points in polygons if points is not None]
        if len(good) < len(given):
            problems.append(f"{where}: {len(given) - len(good)} invalid polygons left out")
        if not good:
            raise ValueError("no valid polygon")
        runs = coco_mask.merge(coco_mask.frPyObjects(good, image.height, image.width))
    if int(coco_mask.area(runs)) == 0:
        raise ValueError("the mask is empty")
    return dict(runs)


def _polygon(points: object) -> list[float] | None:
    """At least three corners as a flat list of x, y; None for anything else."""
    try:
        flat = _POLYGON.validate_python(points)
    except ValidationError:
        return None
    if len(flat) % 2:
        return None
    corners: Array = np.array(flat).reshape(-1, 2)
    edges = np.abs(corners - np.roll(corners, 1, axis=0)).max(axis=1)
    far = np.abs(corners).max() > MAX_PERIMETER_PX
    return None if far or edges.sum() > MAX_PERIMETER_PX else flat


def _run_lengths(given: _RunLengths, image: _Image) -> dict[str, Any]:
    """Compressed run lengths from compressed or plain ones."""
    size = [image.height, image.width]
    if given.size != size:
        raise ValueError(f"a mask of size {given.size} in {size}")
    if isinstance(given.counts, str):
        lengths = decoded_lengths(given.counts)
    else:
        lengths = np.array(given.counts, np.int64)
    if lengths.sum() != image.height * image.width or lengths.min(initial=0) < 0:
        raise ValueError(f"run lengths that do not add up to {image.height * image.width} pixels")
    if isinstance(given.counts, str):
        return {"size": size, "counts": given.counts.encode("ascii")}
    plain = {"size": size, "counts": lengths.tolist()}
    return dict(coco_mask.frPyObjects(plain, image.height, image.width))


def decoded_lengths(text: str) -> Ints:
    """The run lengths (N,) in COCO's compressed text; they may not make sense, but are finite.

    A number takes one to seven characters with five bits each, the lowest first; from the fourth
    number on it is the difference to the number two places before.

    Raises:
        ValueError: other characters, a number that does not end, or one of more than 35 bits.
    """
    codes: Ints = np.frombuffer(text.encode("utf-8"), np.uint8).astype(np.int64) - 48
    if len(codes) == 0 or codes.min() < 0 or codes.max() > 63 or codes[-1] & 32:
        raise ValueError("run lengths that are no compressed numbers")
    ends = np.flatnonzero((codes & 32) == 0)
    first = np.concatenate(([0], ends[:-1] + 1))
    if (ends - first).max() > 6:
        raise ValueError("run lengths that are no compressed numbers")
    place = np.arange(len(codes)) - np.repeat(first, ends - first + 1)
    values = np.add.reduceat((codes & 31) << (5 * place), first)
    negative = (codes[ends] & 16) > 0
    values -= np.where(negative, 1 << (5 * (ends - first + 1)), 0)
    tail = values[1:]  # of the first number nothing is subtracted
    for start in (0, 1):
        tail[start::2] = np.cumsum(tail[start::2])
    return values
