"""Label sets: the class that each number stands for."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.graph.data_files import data_path
from bmask_slam.graph.errors import InputError

BACKGROUND = "background"
UNKNOWN = "unknown"
"""Name of label 0 for landmarks and objects: of no class of the set."""
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


def read_label_set(name: str) -> LabelSet:
    """Read a set from a file with one class a line, or by the bare name of one in ``data/labels``.

    Raises:
        InputError: no such file, no class in it, or a class on two lines.
    """
    path = data_path("labels", f"{name}.txt") if re.fullmatch(r"[\w-]+", name) else Path(name)
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as text; give one class name a line") from error
    classes = [line for line in lines if line and not line.startswith("#")]
    if not classes:
        raise InputError(f"{path}: there is no class in it; give one class name a line")
    named = [c for c in classes if c != UNUSED]
    repeated = next((c for c in named if named.count(c) > 1), None)
    if repeated is not None:
        raise InputError(f"{path}: the class {repeated!r} stands on two lines; remove one")
    return label_set(classes)
