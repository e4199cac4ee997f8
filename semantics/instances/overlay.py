"""Instances drawn over their image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bmask_slam.graph.arrays import Bytes, Floats, Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.instances.surfaces import SurfaceClasses, most_probable
from bmask_slam.semantics.labels import LabelSet

OPACITY, SURFACE_OPACITY = 0.45, 0.6
NAMED_SHARE = 0.01
"""Areas of this share of the image have their class written on them."""
FONT = cv2.FONT_HERSHEY_SIMPLEX


def draw(image: Image, instances: Sequence[Instance], labels: LabelSet) -> Bytes:
    """The image (H, W, 3) with masks in class colours, outlines, class names and mask scores."""
    canvas = image.astype(np.float32)
    for instance in reversed(instances):  # the best on top
        colour = class_colour(instance.label)
        canvas[instance.mask] += OPACITY * (colour - canvas[instance.mask])
    drawn = np.ascontiguousarray(canvas.round().astype(np.uint8))
    for instance in reversed(instances):
        line = tuple(int(c) for c in class_colour(instance.label))
        outline, _ = cv2.findContours(
            instance.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
        )
        cv2.drawContours(drawn, outline, -1, line, 1)
        text = f"{labels.names[instance.label]} {instance.mask_score:.2f}"
        corner = (int(instance.box[0]) + 2, max(int(instance.box[1]) + 12, 12))
        cv2.putText(drawn, text, corner, FONT, 0.4, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(drawn, text, corner, FONT, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
    return drawn


def draw_surfaces(image: Image, seen: SurfaceClasses) -> Image:
    """The image (H, W, 3) with the likeliest class of every pixel, and its name in large areas.

    The surer the class, the stronger its colour.
    """
    label, probability = most_probable(seen)
    colours = np.array([class_colour(k) * 0.8 for k in range(len(seen.labels))], np.float32)
    share = SURFACE_OPACITY * probability[..., None]
    drawn = ((1 - share) * image + share * colours[label]).round().astype(np.uint8)
    for k in np.unique(label).tolist():
        count, parts, stats, _ = cv2.connectedComponentsWithStats((label == k).astype(np.uint8))
        for part in range(1, count):
            if stats[part, cv2.CC_STAT_AREA] >= NAMED_SHARE * label.size:
                inside = np.pad((parts == part).astype(np.uint8), 1)
                far = cv2.distanceTransform(inside, cv2.DIST_L2, 3)
                row, column = np.unravel_index(int(far.argmax()), far.shape)
                corner = (max(int(column) - 20, 2), int(row) + 4)
                name = seen.labels.names[k]
                cv2.putText(drawn, name, corner, FONT, 0.45, (0, 0, 0), 3, cv2.LINE_AA)
                cv2.putText(drawn, name, corner, FONT, 0.45, (255, 255, 160), 1, cv2.LINE_AA)
    return drawn


def class_colour(label: int) -> Floats:
    """A bright colour (3,), red first, that depends on the label alone."""
    hue = (label * 0.61803398875) % 1.0  # golden ratio: neighbours differ
    hsv = np.array([[[hue * 180, 200, 255]]], np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0], np.float32)
