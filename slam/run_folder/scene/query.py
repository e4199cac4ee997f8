"""Queries for the objects of a run: by label, by place, by relation to other objects."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.errors import InputError, did_you_mean, is_whole
from bmask_slam.run_folder.map_file import check_finished
from bmask_slam.run_folder.semantic_files import OBJECTS, SavedObject, SavedScene, read_scene
from bmask_slam.semantics.objects.relations import RELATIONS, distance_m, relations


@dataclass(frozen=True, eq=False)
class Asked:
    """What is asked for; what is not given does not matter.

    Attributes:
        label: a class name.
        near_world: (3,) a place in metres; the nearest object is first.
        relation: one of RELATIONS, to ``other``: a class name, or the id of an object.
        most: the largest number of objects.
    """

    label: str | None = None
    near_world: Array | None = None
    relation: str | None = None
    other: str = ""
    most: int | None = None

    def __post_init__(self) -> None:
        if self.near_world is not None and not np.isfinite(self.near_world).all():
            place = " ".join(f"{value:g}" for value in self.near_world)
            raise InputError(f"--near {place}: give three finite coordinates in metres")


@dataclass(frozen=True, eq=False)
class Answer:
    """The objects that were asked for.

    Attributes:
        label: of all of them; "" for any.
        objects: by label, the most probable first; or the nearest, or the most probable of any
            label first.
        counts: number of objects of the run by label.
        omitted: number of objects beyond those that were asked for.
        distances_m: of the objects from the place that was asked for; empty without one.
        others: of each object, those that it has the relation to, as text; empty without one.
        relation: that was asked for, and to what, as text; "" for none.
    """

    label: str
    objects: tuple[SavedObject, ...]
    counts: dict[str, int]
    omitted: int = 0
    distances_m: tuple[float, ...] = ()
    others: tuple[str, ...] = ()
    relation: str = ""


def query(run: Path, label: str | None, most: int | None = None) -> Answer:
    """The objects of a run with this most probable label; of all labels without one.

    With ``most`` only so many, the most probable.

    Raises:
        InputError: the run has no objects.json, or its label set lacks the label.
    """
    return ask(run, Asked(label, most=most))


def finished_scene(run: Path) -> SavedScene:
    """As `read_scene`; for a run that was killed and can go on, InputError says that."""
    if not (run / OBJECTS).is_file():
        check_finished(run)
    return read_scene(run)


def ask(run: Path, asked: Asked) -> Answer:
    """The objects of a run that are asked for.

    Raises:
        InputError: there is no run, it has no objects.json, its label set lacks a label, or there
            is no object of the id that a relation names.
    """
    scene = finished_scene(run)
    counts = dict(sorted(Counter(o.label for o in scene.objects).items()))
    for name in (asked.label, None if is_whole(asked.other) else asked.other or None):
        if name is not None and name not in scene.names:
            near = did_you_mean(name, scene.names[1:]).rstrip("?")
            raise InputError(
                f"{run}: its label set has no {name!r}{near}; the run holds {_listed(counts)}; "
                f"the set has {', '.join(scene.names[1:])}"
            )
    chosen = [o for o in scene.objects if asked.label in (None, o.label)]
    others = _related(run, scene, asked)
    if asked.relation is not None:
        chosen = [o for o in chosen if o.id in others]
    ordered = _ordered(chosen, asked)
    shown = tuple(ordered if asked.most is None else ordered[: asked.most])
    place = asked.near_world
    return Answer(
        asked.label or "",
        shown,
        counts,
        len(ordered) - len(shown),
        () if place is None else tuple(distance_m(o.box, place) for o in shown),
        tuple(others[o.id] for o in shown) if asked.relation is not None else (),
        f"{asked.relation} {asked.other or 'any other'}" if asked.relation is not None else "",
    )


def _ordered(chosen: list[SavedObject], asked: Asked) -> list[SavedObject]:
    """The nearest first, or those of a label together, or the most probable first."""
    order = sorted(chosen, key=lambda o: (o.label, -o.probability, -len(o.keyframes), o.id))
    place = asked.near_world
    if place is not None:
        return sorted(order, key=lambda o: distance_m(o.box, place))
    return order if asked.most is None else sorted(order, key=lambda o: -o.probability)


def _related(run: Path, scene: SavedScene, asked: Asked) -> dict[int, str]:
    """What is in the relation that is asked for, by id, with a text on what it is related to."""
    if asked.relation is None:
        return {}
    if asked.relation not in RELATIONS:
        raise InputError(f"relation {asked.relation!r}: not known; give {', '.join(RELATIONS)}")
    objects = scene.objects
    number = int(asked.other) if is_whole(asked.other) else None
    if number is not None and number not in {o.id for o in objects}:
        known = ", ".join(f"{o.id} ({o.label})" for o in objects) or "none"
        raise InputError(f"{run}: has no object {asked.other}; there are {known}")
    found: dict[int, list[str]] = {}
    for r in relations([o.box for o in objects], scene.up_world):
        other = objects[r.object]
        if r.kind == asked.relation and (asked.other in ("", other.label) or other.id == number):
            found.setdefault(objects[r.subject].id, []).append(f"{other.label} {other.id}")
    return {number: f"{asked.relation} {', '.join(names)}" for number, names in found.items()}


def format_answer(answer: Answer) -> str:
    """One line an object: position and size in metres, probability, observing keyframes."""
    if not answer.objects:
        sought = " ".join(filter(None, (answer.label or "object", answer.relation)))
        return f"no {sought}; the run holds {_listed(answer.counts)}"
    head = f"{'label':<16}{'id':>5}  {'x, y, z (world, m)':<24}{'size (m)':<19}{'sure':>5}"
    more = ["distance (m)"] * bool(answer.distances_m) + ["relation"] * bool(answer.others)
    lines = ["  ".join([head, *more, "keyframes"])]
    for k, o in enumerate(answer.objects):
        place = " ".join(f"{v:7.3f}" for v in o.centroid_world)
        size = " ".join(f"{v:5.2f}" for v in (*-np.sort(-o.box.size_m[:2]), o.box.size_m[2]))
        line = f"{o.label:<16}{o.id:>5}  {place:<24}{size:<19}{o.probability:>5.2f}"
        more = [f"{answer.distances_m[k]:>12.2f}"] if answer.distances_m else []
        more += [answer.others[k]] if answer.others else []
        lines.append("  ".join([line, *more, _ranges(o.keyframes.tolist())]))
    if answer.omitted:
        rest = "are farther away" if answer.distances_m else "are less sure"
        lines.append(f"and {answer.omitted} objects that {rest}: --all")
    return "\n".join(lines)


def answer_as_json(answer: Answer) -> str:
    """The answer as JSON: metres in the world frame, names as in objects.json."""
    found: list[dict[str, Any]] = [
        {
            "id": o.id,
            "label": o.label,
            "probability": o.probability,
            "centroid_world_m": o.centroid_world.tolist(),
            "box": {"T_world_box": o.box.T_world_box.tolist(), "size_m": o.box.size_m.tolist()},
            "keyframes": o.keyframes.tolist(),
        }
        for o in answer.objects
    ]
    for key, values in (("distance_m", answer.distances_m), ("relation", answer.others)):
        for one, value in zip(found, values, strict=False):  # none, if it was not asked for
            one[key] = value
    content = {"objects": found, "counts": answer.counts, "omitted": answer.omitted}
    return json.dumps(content, indent=1)


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
