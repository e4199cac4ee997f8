"""Label sets: which number stands for which class."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from bmask_slam.graph.data_files import data_path
from bmask_slam.graph.errors import InputError

BACKGROUND = "background"
UNKNOWN = "unknown"
"""What label 0 means of a thing in the map: on no object that the set has a name for."""
UNUSED = "N/A"
"""Name of a number that stands for no class."""


@dataclass(frozen=True)
class LabelSet:
    """Class names by label; label 0 is the background."""

    names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.names)

    def of_thing(self, label: int) -> str:
        """The name of a label of something in the map."""
        return self.names[label] if label else UNKNOWN

    def number(self, name: str) -> int:
        """The label of a class; 0 if the set does not have it."""
        return self.names.index(name) if name in self.names else 0


def label_set(classes: tuple[str, ...] | list[str]) -> LabelSet:
    """The set with these classes as labels 1, 2, ..."""
    return LabelSet((BACKGROUND, *classes))


def read_label_set(name: str) -> LabelSet:
    """A set from its file, one class a line, or from the bare name of one in ``data/labels``.

    Raises:
        InputError: no such file, no class in it, or a class that stands on two lines.
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
    twice = next((c for c in named if named.count(c) > 1), None)
    if twice is not None:
        raise InputError(f"{path}: the class {twice!r} stands on two lines; remove one")
    return label_set(classes)
