"""A segmenter of your own.

    PYTHONPATH=examples bmask-slam run RECORDING --segmenter own_segmenter:RedThings

In Python: ``SlamSystem(camera, segmenter=RedThings())``; for LiveSlam, whose segmenter has a
process of its own, ``SegmenterOptions.named("own_segmenter:RedThings")`` in the configuration.
"""

import cv2
import numpy as np

from bmask_slam.semantics.instances.instances import Instance, certain, mask_box
from bmask_slam.semantics.labels import label_set


class RedThings:
    """Finds connected red regions of at least 400 pixels."""

    labels = label_set(["red thing"])

    def segment(self, image: np.ndarray, name: str) -> list[Instance]:
        """The regions in an image (H, W, 3), red first, the largest first."""
        red, green, blue = np.moveaxis(image.astype(int), 2, 0)
        mask = (red > 100) & (red > 2 * np.maximum(green, blue))
        count, regions, statistics, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
        areas = statistics[:, cv2.CC_STAT_AREA]
        large = [k for k in np.argsort(-areas).tolist() if 0 < k < count and areas[k] >= 400]
        score = 0.9  # the class's probability, and the mask's
        return [
            Instance(shape, mask_box(shape), 1, certain(1, len(self.labels), score), score, score)
            for shape in (regions == k for k in large)
        ]
