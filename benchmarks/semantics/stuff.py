"""What the head that gives every pixel a class reaches on NYU Depth v2's official test images.

    python -m benchmarks.semantics.stuff [--weights F] [--part test|held-out] [--scale S] [--turn D]

Pixels without a class, and those of otherprop, do not count. Classes are the likeliest of the 39;
groups the likeliest of the 13, whose probabilities are sums. Accuracy is the share of a class's
pixels that are found; IoU is over all images. Cost is processor time of one thread. With a scale
or a turn the middle of each image is enlarged or turned, as a camera that is near, or not upright,
would see it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from benchmarks.semantics.nyuv2 import CLASSES, GROUP_OF, GROUPS, labelled, numbers
from benchmarks.semantics.train_stuff import held_out
from bmask_slam.graph.arrays import Array, Bytes, Image, Ints
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.semantics.training.stuff_images import IGNORED, placed
from bmask_slam.semantics.weights import light_weights, stuff_weights


def confusion(truth: Bytes | Ints, found: Bytes | Ints, classes: int) -> Ints:
    """Counts (C, C) of pixels: rows are true classes, columns found ones."""
    known = truth != IGNORED
    pairs = truth[known].astype(np.int64) * classes + found[known]
    return np.bincount(pairs, minlength=classes**2).reshape(classes, classes)


def figures(counts: Ints) -> tuple[Array, Array, float]:
    """IoU (C,) and accuracy (C,), NaN for a class that is not there, and pixel accuracy."""
    right, there, found = np.diag(counts), counts.sum(axis=1), counts.sum(axis=0)
    there = np.where(there > 0, there, np.nan)
    return right / (there + found - right), right / there, float(right.sum() / counts.sum())


def seen_from(image: Image, labels: Bytes, scale: float, turn_deg: float) -> tuple[Image, Bytes]:
    """An image (H, W, 3) and its classes (H, W), enlarged and turned about the middle."""
    height, width = labels.shape
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn_deg, scale)
    return placed(image, labels, np.asarray(matrix, float), (height, width))


def measure(weights: Path, part: str, scale: float, turn_deg: float) -> None:
    """Print the figures of a part of the images."""
    torch.set_num_threads(1)
    detector = light_weights.load_light(data_path(*light_weights.SHIPPED)).model.detector
    network = stuff_weights.load_stuff(weights)
    chosen = numbers("test") if part == "test" else [n for n in numbers("train") if held_out(n)]
    groups = F.one_hot(torch.from_numpy(GROUP_OF), len(GROUPS)).float().T
    fine, coarse = (np.zeros((n, n), np.int64) for n in (CLASSES, len(GROUPS)))
    group_of = np.append(GROUP_OF, [IGNORED] * (256 - CLASSES))
    times, sure = [], np.zeros((10, 3))
    with torch.inference_mode():
        for whole in labelled(chosen):
            image, labels = seen_from(*whole, scale, turn_deg)
            x, _ = detector.letterboxed(torch.from_numpy(image).permute(2, 0, 1))
            stamps = [time.process_time()]
            features = detector.features(x)
            detections = detector.detections(features)
            stamps.append(time.process_time())
            cells = network.head(features, detections)
            stamps.append(time.process_time())
            times.append(np.diff(stamps))
            p = F.interpolate(cells, labels.shape, mode="bilinear")[0].softmax(dim=0)
            found = p.argmax(dim=0).numpy()
            fine += confusion(labels, found, CLASSES)
            grouped = torch.einsum("gc,chw->ghw", groups, p).argmax(dim=0).numpy()
            coarse += confusion(group_of[labels], grouped, len(GROUPS))
            sure += reliability(p, labels, found)
    report(fine, coarse, network.labels.names[1:], len(chosen))
    light_ms, head_ms = 1000 * np.median(times, axis=0)
    error = np.abs(sure[:, 1] - sure[:, 2]).sum() / sure[:, 0].sum()
    print(f"calibration error {error:.3f}")
    print(f"detector {light_ms:.0f} ms, head {head_ms:.0f} ms: ratio {head_ms / light_ms:.2f}")


def reliability(p: Tensor, labels: Bytes | Ints, found: Bytes | Ints) -> Array:
    """Pixels, sum of probabilities and number of right ones (10, 3) by the best probability."""
    known = labels != IGNORED
    best = p.max(dim=0).values.numpy()[known]
    row = np.minimum((best * 10).astype(int), 9)
    right = (labels == found)[known]
    return np.stack([np.bincount(row, w, 10) for w in (np.ones(len(row)), best, right)], axis=1)


def report(fine: Ints, coarse: Ints, names: tuple[str, ...], images: int) -> None:
    """Print the totals and a table of the classes."""
    iou, accuracy, right = figures(fine)
    _, group_accuracy, group_right = figures(coarse)
    print(f"{images} images, {np.isfinite(iou).sum()} of {CLASSES} classes in them")
    print(f"39 classes: mIoU {np.nanmean(iou):.3f}, pixel accuracy {right:.3f}, "
          f"class accuracy {np.nanmean(accuracy):.3f}")  # fmt: skip
    print(f"13 classes: class accuracy {np.nanmean(group_accuracy):.3f}, "
          f"pixel accuracy {group_right:.3f}")  # fmt: skip
    print("13: " + ", ".join(f"{n} {a:.2f}" for n, a in zip(GROUPS, group_accuracy, strict=True)))
    share = fine.sum(axis=1) / fine.sum()
    print(f"\n{'class':16} {'pixels':>7} {'IoU':>6} {'found':>6}")
    for k in np.argsort(-share).tolist():
        print(f"{names[k]:16} {100 * share[k]:6.1f}% {iou[k]:6.3f} {accuracy[k]:6.3f}")


def main() -> None:
    """Measure one file of weights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--part", choices=("test", "held-out"), default="test")
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--turn", type=float, default=0.0, help="degrees")
    arguments = parser.parse_args()
    weights = arguments.weights or data_path(*stuff_weights.SHIPPED)
    measure(weights, arguments.part, arguments.scale, arguments.turn)


if __name__ == "__main__":
    main()
