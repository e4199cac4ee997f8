"""Instances drawn over their image."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from bmask_slam.graph.arrays import Bytes, Floats, Image
from bmask_slam.semantics.instances.instances import Instance
from bmask_slam.semantics.labels import LabelSet

OPACITY = 0.45
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


def class_colour(label: int) -> Floats:
    """A bright colour (3,), red first, that depends on the label alone."""
    hue = (label * 0.61803398875) % 1.0  # golden ratio: neighbours differ
    hsv = np.array([[[hue * 180, 200, 255]]], np.uint8)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0], np.float32)
