"""Class names of the rendered objects: the 23 of the paper's Table 2, in its order."""

from __future__ import annotations

CLASSES: tuple[str, ...] = (
    "chair", "air conditioner", "screen", "robot", "desk", "bookcase", "door", "keyboard", "mouse",
    "drone", "cup", "person", "trophy", "switchbox", "bottle", "flower pot", "book", "tv",
    "jackboard", "cell phone", "potted plant", "suitcase", "umbrella",
)  # fmt: skip
"""A category's id in the annotations is its place here, from 1."""
CATEGORY_IDS: dict[str, int] = {name: i for i, name in enumerate(CLASSES, 1)}
