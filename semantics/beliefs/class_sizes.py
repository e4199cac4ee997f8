"""How large things of a class are, and where they are: data/labels/sizes.yaml."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bmask_slam.graph.arrays import Array, Mask
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import data_path
from bmask_slam.graph.files.yaml_file import read_yaml
from bmask_slam.semantics.labels import LabelSet

FLOOR, SUPPORT, TOP, WALL, ANY, NEVER = "floor", "support", "top", "wall", "any", "never"
PLACES = (FLOOR, SUPPORT, TOP, WALL, ANY, NEVER)
_ROW = ("shortest", "longest", "place")
_ALL_M = (0.01, 100.0)
LONGEST_M = 1e4
"""No class of things is as long."""


@dataclass(frozen=True, eq=False)
class ClassSizes:
    """Of each class of a label set (C,), the first of which is "unknown".

    Attributes:
        shortest_m, longest_m: (C,) the usual range of the longest side.
        tallest_m: (C,) the usual limit of the height; the longest side's where none is known.
        places: C of PLACES, where such a thing is.
    """

    shortest_m: Array
    longest_m: Array
    tallest_m: Array
    places: tuple[str, ...]

    @property
    def typical_m(self) -> Array:
        """Longest side (C,) in the middle of its range, by its logarithm."""
        return np.asarray(np.sqrt(self.shortest_m * self.longest_m))

    def is_in(self, *places: str) -> Mask:
        """Which of the classes (C,) are in one of the places."""
        return np.array([p in places for p in self.places])


def read_sizes(labels: LabelSet) -> ClassSizes:
    """The sizes of a label set's classes; classes that the file lacks may have any.

    Raises:
        InputError: the file is not a table, by class name, of two lengths, a place, and maybe a
            height.
    """
    path = data_path("labels", "sizes.yaml")
    content = read_yaml(path)
    if not isinstance(content, dict):
        raise InputError(f"{path}: needs lines 'class: [shortest, longest, place]'")
    rows = [content.get(name, (*_ALL_M, ANY)) for name in labels.names]
    for name, row in zip(labels.names, rows, strict=True):
        if not _is_row(row):
            raise InputError(
                f"{path}: {name}: {row!r}; give [shortest, longest, place(, tallest)], metres"
            )
    shortest_m, longest_m = (np.array([row[k] for row in rows], float) for k in (0, 1))
    tallest_m = np.array([row[3] if len(row) > len(_ROW) else row[1] for row in rows], float)
    return ClassSizes(shortest_m, longest_m, tallest_m, tuple(row[2] for row in rows))


def _is_row(row: object) -> bool:
    """Whether it is two rising lengths and a place, maybe with a height."""
    if not isinstance(row, (list, tuple)) or len(row) - len(_ROW) not in (0, 1):
        return False
    shortest, longest, place, *tallest = row
    numbers = (shortest, longest, *tallest)
    if not all(isinstance(n, (int, float)) and not isinstance(n, bool) for n in numbers):
        return False
    if not all(0 < n <= longest for n in tallest):
        return False
    return bool(0 < shortest < longest < LONGEST_M) and place in PLACES
