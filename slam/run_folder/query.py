"""Queries for the objects of a run by label."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bmask_slam.graph.errors import InputError
from bmask_slam.run_folder.semantic_files import SavedObject, read_objects


@dataclass(frozen=True, eq=False)
class Answer:
    """The objects that were asked for.

    Attributes:
        label: of all of them; "" for any.
        objects: by label, the most probable first; or the most probable of any label first.
        counts: number of objects of the run by label.
        omitted: number of objects beyond those that were asked for.
    """

    label: str
    objects: tuple[SavedObject, ...]
    counts: dict[str, int]
    omitted: int = 0


def query(run: Path, label: str | None, most: int | None = None) -> Answer:
    """The objects of a run with this most probable label; of all labels without one.

    With ``most`` only so many, the most probable.

    Raises:
        InputError: the run has no objects.json, or its label set lacks the label.
    """
    names, objects = read_objects(run)
    counts = dict(sorted(Counter(o.label for o in objects).items()))
    if label is not None and label not in names:
        raise InputError(
            f"{run}: its label set has no {label!r}; the run holds {_listed(counts)}; the set has "
            f"{', '.join(names[1:])}"
        )
    chosen = [o for o in objects if label in (None, o.label)]
    order = sorted(chosen, key=lambda o: (o.label, -o.probability, -len(o.keyframes), o.id))
    if most is None:
        return Answer(label or "", tuple(order), counts)
    surest = sorted(order, key=lambda o: -o.probability)
    return Answer(label or "", tuple(surest[:most]), counts, max(len(surest) - most, 0))


def format_answer(answer: Answer) -> str:
    """One line an object: position and size in metres, probability, observing keyframes."""
    if not answer.objects:
        return f"no {answer.label or 'object'}; the run holds {_listed(answer.counts)}"
    head = f"{'label':<16}{'id':>5}  {'x, y, z (world, m)':<24}{'size (m)':<19}{'sure':>5}"
    lines = [f"{head}  keyframes"]
    for o in answer.objects:
        place = " ".join(f"{v:7.3f}" for v in o.centroid_world)
        size = " ".join(f"{v:5.2f}" for v in (*-np.sort(-o.box.size_m[:2]), o.box.size_m[2]))
        seen = _ranges(o.keyframes.tolist())
        lines.append(f"{o.label:<16}{o.id:>5}  {place:<24}{size:<19}{o.probability:>5.2f}  {seen}")
    if answer.omitted:
        lines.append(f"and {answer.omitted} objects that are less sure: --all")
    return "\n".join(lines)


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} ({n})" for name, n in counts.items()) or "nothing"


def _ranges(numbers: list[int]) -> str:
    """Ascending numbers as "1-4, 7"."""
    parts: list[list[int]] = []
    for n in numbers:
        if parts and n == parts[-1][-1] + 1:
            parts[-1] = [parts[-1][0], n]
        else:
            parts.append([n])
    return ", ".join("-".join(map(str, p)) for p in parts)
