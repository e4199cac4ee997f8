"""Label sets: the class that each number stands for."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.reading import read_lines

BACKGROUND = "background"
UNKNOWN = "unknown"
"""Name of label 0 for landmarks and objects: of no class of the set."""
MAX_CLASSES, MAX_NAME = 10_000, 200
UNUSED = "N/A"
"""Name of a number that stands for no class."""


@dataclass(frozen=True)
class LabelSet:
    """Class names by label; label 0 is the background."""

    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def map_name(self, label: int) -> str:
        """The name of a label of a landmark or object: "unknown" for label 0."""
        return self.names[label] if label else UNKNOWN

    def number(self, name: str) -> int:
        """The label of a class; 0 if the set does not have it."""
        return self.names.index(name) if name in self.names else 0


def label_set(classes: tuple[str, ...] | list[str]) -> LabelSet:
    """The set with these classes as labels 1, 2, ..."""
    return LabelSet((BACKGROUND, *classes))


def is_shipped_name(name: str) -> bool:
    """Whether a label set is given by the bare name of one in ``data/labels``, not by a file."""
    return re.fullmatch(r"[\w-]+", name) is not None


def read_label_set(name: str) -> LabelSet:
    """Read a set from a file with one class a line, or by the bare name of one in ``data/labels``.

    Raises:
        InputError: no such file, no class in it, or a class on two lines.
    """
    path = data_path("labels", f"{name}.txt") if is_shipped_name(name) else Path(name)
    cure = "give one class name a line"
    classes = [line for _, line in read_lines(path, cure)]
    if not 0 < len(classes) <= MAX_CLASSES:
        many = f"more than {MAX_CLASSES} classes" if classes else "there is no class"
        raise InputError(f"{path}: {many} in it; {cure}")
    long = next((c for c in classes if len(c) > MAX_NAME), None)
    if long is not None:
        raise InputError(f"{path}: {long[:40]!r}... is too long for a name; {cure}")
    counts = Counter(c for c in classes if c != UNUSED)
    repeated = next((c for c, count in counts.items() if count > 1), None)
    if repeated is not None:
        raise InputError(f"{path}: the class {repeated!r} stands on two lines; remove one")
    return label_set(classes)
