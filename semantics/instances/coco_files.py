"""COCO annotation files: every value is checked before pycocotools gets it, which checks nothing.

Masks are decoded one at a time.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.file_names import check_name
from bmask_slam.graph.files.json_file import STRICT, Name, first_problem, read_json
from bmask_slam.semantics.instances.run_lengths import checked_lengths
from bmask_slam.semantics.labels import LabelSet, label_set

logger = logging.getLogger(__name__)

CURE = "give a COCO file with images, annotations and categories"
MAX_SIDE = 65_535
MAX_PIXELS = 100_000_000
MAX_CORNERS = 100_000
"""Of a polygon."""
MAX_PERIMETER_PX = 10_000_000
"""Of a polygon: pycocotools takes memory for each pixel on its edges, also outside the image."""
EDGE_PX_A_BYTE = 20
"""Of all polygons, for each byte of the file, beside those of one polygon: real ones have one."""
MAX_MASK_BYTES = 1 << 30
"""Of the masks of one image, decoded, a byte a pixel."""
Id = Annotated[int, Field(ge=-(2**53), le=2**53)]
Side = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Probability = Annotated[float, Field(ge=0, le=1 + 1e-6), AfterValidator(lambda p: min(p, 1.0))]
"""A probability that rounding may have put a little above 1."""


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
    _check_unique([c.id for c in content.categories], f"{path}: category id")
    categories = sorted((c.id, c.name) for c in content.categories)
    labels = {number: k for k, (number, _) in enumerate(categories, 1)}
    objects: dict[int, list[CocoObject]] = defaultdict(list)
    problems: list[str] = []
    edges = _Edges(MAX_PERIMETER_PX + EDGE_PX_A_BYTE * path.stat().st_size)
    for raw in content.annotations:
        try:
            annotation = _checked(raw, images, labels)
            image, label = images[annotation.image_id], labels[annotation.category_id]
            _check_room(len(objects[image.id]), image)
            runs = _encoded(annotation, image, f"annotation {_name(raw)}", problems, edges)
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
    _check_unique([image.id for image in listed], f"{path}: image id")
    for image in listed:
        check_name(image.file_name, f"{path}: image {image.id}")
        if image.height * image.width > MAX_PIXELS:
            raise InputError(
                f"{path}: image {image.id} has {image.width} x {image.height} pixels, more than "
                f"{MAX_PIXELS // 10**6} megapixels; correct its size"
            )
    _check_unique([Path(image.file_name).as_posix() for image in listed], f"{path}: image")
    return {image.id: image for image in listed}


def _check_unique(values: Sequence[int | str], what: str) -> None:
    """Raise InputError for a value that stands twice, as in files that were joined."""
    value, count = max(Counter(values).items(), key=lambda item: item[1], default=("", 1))
    if count > 1:
        raise InputError(f"{what} {value} stands {count} times; give each one of its own")


def _check_room(present: int, image: _Image) -> None:
    """Raise ValueError if an image has so many objects that their masks would take all memory."""
    if (present + 1) * image.height * image.width > MAX_MASK_BYTES:
        raise ValueError(f"image {image.id} has {present} objects, which is the limit of its size")


@dataclass
class _Edges:
    """How many pixels of edges the polygons of a file may still have."""

    left_px: float

    def take(self, pixels: float) -> None:
        """Raise ValueError if there are not so many left."""
        if pixels > self.left_px:
            raise ValueError("segmentation: the edges of the file's polygons are too long")
        self.left_px -= pixels


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
    annotation: _Annotation, image: _Image, where: str, problems: list[str], edges: _Edges
) -> dict[str, Any]:
    """The mask as compressed run lengths. Raises ValueError with the reason if it is invalid."""
    given = annotation.segmentation
    if given is None:
        raise ValueError("no segmentation")
    if isinstance(given, _RunLengths):
        lengths = checked_lengths(given.counts, given.size, [image.height, image.width])
        if isinstance(given.counts, str):
            runs = {"size": given.size, "counts": given.counts.encode("ascii")}
        else:
            plain = {"size": given.size, "counts": lengths.tolist()}
            runs = coco_mask.frPyObjects(plain, image.height, image.width)
    else:
        polygons = [_polygon(points, edges) for points in given]
        good = [points for points in polygons if points is not None]
        if len(good) < len(given):
            problems.append(f"{where}: {len(given) - len(good)} invalid polygons left out")
        if not good:
            raise ValueError("no valid polygon")
        runs = coco_mask.merge(coco_mask.frPyObjects(good, image.height, image.width))
    if int(coco_mask.area(runs)) == 0:
        raise ValueError("the mask is empty")
    return dict(runs)


def _polygon(points: object, edges: _Edges) -> list[float] | None:
    """At least three corners as a flat list of x, y; None for anything else. Raises ValueError."""
    try:
        flat = _POLYGON.validate_python(points)
    except ValidationError:
        return None
    if len(flat) % 2:
        return None
    corners: Array = np.array(flat).reshape(-1, 2)
    around_px = np.abs(corners - np.roll(corners, 1, axis=0)).max(axis=1).sum()
    if np.abs(corners).max() > MAX_PERIMETER_PX or around_px > MAX_PERIMETER_PX:
        return None
    edges.take(float(around_px))
    return flat
