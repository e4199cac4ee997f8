"""Class names of the rendered objects: the 23 of the paper's Table 2, in its order."""

from __future__ import annotations

from bmask_slam.semantics.labels import read_label_set

CLASSES: tuple[str, ...] = read_label_set("paper").names[1:]
"""A category's id in the annotations is its place here, from 1."""
CATEGORY_IDS: dict[str, int] = {name: i for i, name in enumerate(CLASSES, 1)}
