"""COCO's metrics of a segmenter: box and mask AP, with and without the predicted mask IoU."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib.figure
import numpy as np
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from bmask_slam.graph.arrays import Array, Image
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.whole_file import whole_file
from bmask_slam.semantics.instances.coco_files import CocoFile, CocoImage
from bmask_slam.semantics.instances.image_files import read_colour
from bmask_slam.semantics.instances.instances import Instance, as_annotation
from bmask_slam.semantics.segmenters.segmenter import Segmenter

CLASS_SCORE = "class score"
MASK_SCORE = "class score x MaskIoU"
MATCH_IOU = 0.5
"""A detection matches the object of its class with the largest box overlap of at least this, as in
the training of the mask and MaskIoU heads."""
_Entry = dict[str, Any]
"""A detection in pycocotools' format, with its mask score beside it."""
AP_50 = 0
"""Index of the threshold 0.5 among COCO's ten."""


@dataclass(frozen=True, eq=False)
class ApCurve:
    """COCO's average precision and the curve behind it.

    Attributes:
        kind: "bbox" or "segm".
        ranked_by: the score that orders detections.
        ap, ap50, ap75: means over the classes that occur, in 0..1.
        precision: (101,) at recalls 0, 0.01, ..., 1 and IoU 0.5, mean over classes.
    """

    kind: str
    ranked_by: str
    ap: float
    ap50: float
    ap75: float
    precision: Array


@dataclass(frozen=True, eq=False)
class SegmentationResult:
    """All metrics of one segmenter on one data set.

    Attributes:
        curves: box AP by class score, mask AP by class score, mask AP by mask score.
        iou_correlation: Pearson's, of predicted and true mask IoU of matched detections; NaN for
            fewer than 3, or without predicted IoUs.
        iou_correlation_of_good: the same of those with a true IoU of at least 0.5.
        images, instances: their numbers.
        iou_pairs: (N, 2) predicted and true mask IoU of matched detections.
    """

    curves: tuple[ApCurve, ...]
    iou_correlation: float
    iou_correlation_of_good: float
    images: int
    instances: int
    iou_pairs: Array = field(default_factory=lambda: np.zeros((0, 2)))


def evaluate_segmenter(
    segmenter: Segmenter,
    truth: CocoFile,
    folder: Path,
    progress: Callable[[int, int], None],
) -> SegmentationResult:
    """Run a segmenter on the images of a COCO file and compare; classes are matched by name.

    Objects of classes that are not in the segmenter's label set are removed from the truth.

    Raises:
        InputError: the label sets have no class in common, or an image is missing, broken or of
            another size than its annotations.
    """
    numbers = [segmenter.labels.number(name) for name in truth.labels.names]
    if not any(numbers):
        raise InputError(f"{folder}: none of the data's classes is among the segmenter's")
    found: list[_Entry] = []
    of_images = []
    for k, image in enumerate(truth.images, 1):
        instances = segmenter.segment(_pixels_of(image, folder), image.file_name)
        of_images.append(_iou_pairs(instances, image, numbers))
        found.extend(_entry(i, k) for i in instances)
        progress(k, len(truth.images))
    known = COCO()
    with contextlib.redirect_stdout(io.StringIO()):
        known.dataset = _truth(truth.images, numbers)
        known.createIndex()
    ways = (("bbox", CLASS_SCORE), ("segm", CLASS_SCORE), ("segm", MASK_SCORE))
    curves = tuple(_average_precision(known, found, *way) for way in ways)
    pairs = np.concatenate(of_images)
    good = pairs[pairs[:, 1] >= MATCH_IOU]
    return SegmentationResult(
        curves,
        iou_correlation=_correlation(pairs),
        iou_correlation_of_good=_correlation(good),
        images=len(of_images),
        instances=len(found),
        iou_pairs=pairs,
    )


def _pixels_of(annotated: CocoImage, folder: Path) -> Image:
    """The image (H, W, 3), of the size of its annotations: masks of another would match none."""
    path = folder / annotated.file_name
    image = read_colour(path)
    if image.shape[:2] != (annotated.height, annotated.width):
        raise InputError(
            f"{path}: has {image.shape[1]}x{image.shape[0]} pixels, its annotations "
            f"{annotated.width}x{annotated.height}; give the images that were annotated"
        )
    return image


def _entry(instance: Instance, image: int) -> _Entry:
    """A detection in the image of a number; the mask as run lengths, the only copy that is kept."""
    entry = as_annotation(instance)
    del entry["distribution"]
    return {**entry, "image_id": image, "score": instance.class_score,
            "mask_score": instance.mask_score}  # fmt: skip


def _truth(images: Sequence[CocoImage], numbers: Sequence[int]) -> dict[str, Any]:
    """The annotations in pycocotools' format, with the segmenter's labels."""
    annotations: list[dict[str, Any]] = []
    for k, image in enumerate(images, 1):
        for o in image.objects:
            if numbers[o.label] == 0:
                continue
            x1, y1, x2, y2 = o.box
            annotations.append({
                "id": len(annotations) + 1, "image_id": k, "category_id": numbers[o.label],
                "bbox": [x1, y1, x2 - x1, y2 - y1], "area": float(coco_mask.area(o.runs)),
                "segmentation": o.runs, "iscrowd": int(o.crowd),
            })  # fmt: skip
    sizes = [{"id": k, "height": i.height, "width": i.width} for k, i in enumerate(images, 1)]
    return {
        "images": sizes,
        "categories": [{"id": n} for n in sorted({n for n in numbers if n})],
        "annotations": annotations,
    }


def _average_precision(known: COCO, found: Sequence[_Entry], kind: str, ranked_by: str) -> ApCurve:
    key = "score" if ranked_by == CLASS_SCORE else "mask_score"
    unused = "segmentation" if kind == "bbox" else ""
    entries = [{**{k: v for k, v in e.items() if k != unused}, "score": e[key]} for e in found]
    if not entries:
        return ApCurve(kind, ranked_by, 0.0, 0.0, 0.0, np.zeros(101))
    with contextlib.redirect_stdout(io.StringIO()):
        evaluation = COCOeval(known, known.loadRes(entries), kind)
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    precision = evaluation.eval["precision"][AP_50, :, :, 0, -1]  # of all areas, 100 detections
    occurring = precision[:, (precision > -1).any(axis=0)]
    ap, ap50, ap75 = (max(float(v), 0.0) for v in evaluation.stats[:3])
    mean = np.mean(occurring, axis=1) if occurring.size else np.zeros(101)
    return ApCurve(kind, ranked_by, ap, ap50, ap75, mean)


def _iou_pairs(found: Sequence[Instance], image: CocoImage, numbers: Sequence[int]) -> Array:
    """(N, 2) predicted and true mask IoU of the detections that match an object."""
    pairs = []
    for i in found:
        same = [o for o in image.objects if numbers[o.label] == i.label and not o.crowd]
        if not same:
            continue
        boxes = np.array([o.box for o in same])
        overlap = coco_mask.iou(_with_size(i.box[None]), _with_size(boxes), [0] * len(same))
        best = int(np.argmax(overlap))
        if overlap[0, best] >= MATCH_IOU:
            runs = coco_mask.encode(np.asfortranarray(i.mask.astype(np.uint8)))
            true_iou = float(coco_mask.iou([runs], [same[best].runs], [0])[0, 0])
            pairs.append((i.mask_score / max(i.class_score, 1e-9), true_iou))
    return np.array(pairs, np.float64).reshape(-1, 2)


def _with_size(boxes: NDArray[Any]) -> Array:
    """x, y, width, height of boxes (N, 4)."""
    return np.c_[boxes[:, :2], boxes[:, 2:] - boxes[:, :2]].astype(np.float64)


def _correlation(pairs: Array) -> float:
    if len(pairs) < 3 or pairs[:, 0].std() < 1e-9 or pairs[:, 1].std() < 1e-9:
        return float("nan")
    matrix: Array = np.asarray(np.corrcoef(pairs.T), np.float64)
    return float(matrix[0, 1])


def draw_precision_recall(result: SegmentationResult, picture: Path) -> None:
    """Precision against recall at IoU 0.5 (the paper's Fig. 9)."""
    figure = matplotlib.figure.Figure(figsize=(5, 4), layout="constrained")
    axes = figure.add_subplot()
    for curve in result.curves:
        label = f"{curve.kind}, by {curve.ranked_by}"
        axes.plot(np.linspace(0, 1, 101), curve.precision, label=label)
    axes.set(xlabel="recall", ylabel="precision at IoU 0.5", xlim=(0, 1), ylim=(0, 1))
    axes.legend()
    axes.grid(alpha=0.3)
    with whole_file(picture) as temporary:
        figure.savefig(temporary, dpi=120)


def write_curves(result: SegmentationResult, path: Path) -> None:
    """Write the curves as a table of kind, ranked_by, recall and precision at IoU 0.5."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        whole_file(path) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("kind", "ranked_by", "recall", "precision"))
        for curve in result.curves:
            for k, precision in enumerate(curve.precision):
                writer.writerow((curve.kind, curve.ranked_by, f"{k / 100:.2f}", f"{precision:.6f}"))


def format_segmentation(result: SegmentationResult) -> str:
    """A table for a terminal."""
    lines = [f"{'':8} {'ranked by':24} {'AP':>7} {'AP50':>7} {'AP75':>7}"]
    for c in result.curves:
        kind = "boxes" if c.kind == "bbox" else "masks"
        lines.append(f"{kind:8} {c.ranked_by:24} {c.ap:7.4f} {c.ap50:7.4f} {c.ap75:7.4f}")
    lines.append(
        f"correlation of predicted and true mask IoU  {result.iou_correlation:.3f}, "
        f"where the true one is at least 0.5  {result.iou_correlation_of_good:.3f}"
    )
    lines.append(f"{result.instances} instances in {result.images} images")
    return "\n".join(lines)
