"""Factors that a user has made with GTSAM: their variables, their text in files, and checks.

Keys are those of `graph.factors.keys`. What enters is the user's own factor, with his noise and his
robust kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np

from bmask_slam.graph.arrays import Arrays, Ints, no_ids
from bmask_slam.graph.errors import InputError
from bmask_slam.graph.factors.factor_tables import NO_SLOT, FactorTables, OwnFactor
from bmask_slam.graph.factors.graph_update import GraphUpdate
from bmask_slam.graph.factors.gtsam_factors import make_graph, make_values
from bmask_slam.graph.factors.keys import LANDMARK_BASE, variables_of_keys

Numbered = tuple[int, Any]
"""A factor of a user, or its text, with its number."""
Variable = tuple[str, int]
"""("keyframe" or "landmark", id)."""
MAX_TEXT = 1_000_000
"""Characters of a factor's text; a prior's has 500."""


def own_factor(factor: Any) -> OwnFactor:
    """A user's factor, whose variables are named by its keys.

    Raises:
        InputError: it is no GTSAM factor, or a key is neither a keyframe's nor a landmark's.
    """
    if not isinstance(factor, gtsam.NonlinearFactor):
        raise InputError(f"add_factor: a {type(factor).__name__}; give a factor of GTSAM")
    return OwnFactor(factor, *variables_of_keys(list(factor.keys())))


def checked_own_factors(
    given: Sequence[Numbered], tables: FactorTables
) -> tuple[tuple[int, OwnFactor], ...]:
    """Numbered factors, or texts of them, that can enter the graph. Raises InputError."""
    found = []
    for number, factor in given:
        own = own_factor(factor_of(factor) if isinstance(factor, str) else factor)
        check_own_factor(own, tables)
        found.append((number, own))
    return tuple(found)


def check_own_factor(own: OwnFactor, tables: FactorTables, where: str = "add_factor") -> None:
    """Refuse a factor that cannot enter a graph as it is now.

    What cannot be checked: a ``gtsam.CustomFactor`` with Jacobians of a wrong shape, or without
    some, ends the process in GTSAM; and what a factor does at other values.

    Raises:
        InputError: a variable is not in the graph or of another type than the factor's, or its
            error or its Jacobians are not finite there.
    """
    for what, ids, known in (
        ("keyframe", own.keyframes, tables.keyframes),
        ("landmark", own.landmarks, tables.landmarks),
    ):
        for number in ids:
            if not known.contains(np.array([number])).all():
                raise InputError(
                    f"{where}: {what} {number} is not in the graph (culled, or not there yet); "
                    "use one that is"
                )
    keyframes, landmarks = np.array(own.keyframes, int), np.array(own.landmarks, int)
    poses, points = tables.keyframes.get(keyframes), tables.landmarks.get(landmarks)
    values = make_values(keyframes, poses, landmarks, points)
    try:
        error, linear = own.factor.error(values), own.factor.linearize(values)
    except Exception as reason:  # it may be a user's code
        raise InputError(f"{where}: its error cannot be computed: {reason}") from reason
    if not np.isfinite(error):
        raise InputError(f"{where}: its error is {error}; correct its measurement or its noise")
    if linear is not None and not np.isfinite(linear.augmentedInformation()).all():
        raise InputError(f"{where}: its Jacobians are not finite; correct them or its noise")


def suspects(named: Variable | None, new: Sequence[int], tables: FactorTables) -> list[int]:
    """The users' factors that may have made the solver fail near a variable, if it named one.

    Those that cannot be evaluated; if all can, the new ones; else those of the variable.
    """
    found = failing(tables) or [n for n in new if n in tables.own_factors]
    if found:
        return found
    return [n for n, own in sorted(tables.own_factors.items()) if _concerns(own, named)]


def failing(tables: FactorTables) -> list[int]:
    """The users' factors that cannot be evaluated now, though their variables are there."""
    present = [(n, o) for n, o in sorted(tables.own_factors.items()) if tables.has_variables(o)]
    return [n for n, own in present if _fails(own, tables)]


def _fails(own: OwnFactor, tables: FactorTables) -> bool:
    try:
        check_own_factor(own, tables)
    except InputError:
        return True
    return False


def _concerns(own: OwnFactor, named: Variable | None) -> bool:
    if named is None:
        return True
    return named[1] in (own.keyframes if named[0] == "keyframe" else own.landmarks)


def exchange_own_factors(
    update: GraphUpdate, tables: FactorTables
) -> tuple[list[int], list[int], tuple[int, ...]]:
    """Carry out an update's changes: numbers lost with a variable, slots removed, numbers added."""
    numbers = update.remove_own_factors
    gone = [n for n in numbers if n in tables.own_factors]
    own = tables.own_factors.items()
    lost = [n for n, one in own if n not in numbers and not tables.has_variables(one)]
    slots = [tables.own_factors.pop(n).slot for n in (*gone, *lost)]
    added = {n: one for n, one in update.own_factors if tables.has_variables(one)}
    lost += [n for n, _ in update.own_factors if n not in added]
    tables.own_factors |= added
    tables.next_own = max([tables.next_own, *(n + 1 for n in added)])
    return lost, [slot for slot in slots if slot != NO_SLOT], tuple(added)


def own_gtsam_factors(tables: FactorTables) -> list[Any]:
    """The factors of a user, by number, without those that have lost a variable."""
    own = (one for _, one in sorted(tables.own_factors.items()))
    return [one.factor for one in own if tables.has_variables(one)]


def text_of(factor: Any, number: int | None = None) -> str:
    """A factor in GTSAM's own format, for a file or another process.

    Raises:
        InputError: it has none, as a ``gtsam.CustomFactor``, which is Python code.
    """
    name = "" if number is None else f" {number}"
    try:
        text = str(make_graph([factor]).serialize())
    except RuntimeError as reason:
        raise InputError(
            f"own factor{name}: a {type(factor).__name__} cannot be saved or sent to another "
            "process, since it is code; remove it first (remove_factor), or use a factor of GTSAM"
        ) from reason
    if len(text) > MAX_TEXT:
        raise InputError(f"own factor{name}: more than {MAX_TEXT} characters; divide it")
    return text


def factor_of(text: str) -> Any:
    """The factor of ``text_of``. Raises ValueError for another text.

    The reader is boost's, which believes the lengths in a text: here none may exceed the text's.
    """
    counts = (int(word) for word in text[:MAX_TEXT].split() if word.isdecimal())
    if len(text) > MAX_TEXT or any(len(text) < n < LANDMARK_BASE for n in counts):
        raise ValueError("an own factor cannot be read: it is, or says that it is, too long")
    graph = gtsam.NonlinearFactorGraph()
    try:
        graph.deserialize(text)
    except (RuntimeError, MemoryError) as reason:
        raise ValueError(f"an own factor cannot be read: {reason}") from reason
    if graph.size() != 1:
        raise ValueError(f"an own factor is {graph.size()} factors")
    return graph.at(0)


def without_own(update: GraphUpdate, tables: FactorTables) -> Ints:
    """The landmarks to marginalise, but for those of a user's factors."""
    held = [j for own in tables.own_factors.values() for j in own.landmarks]
    return (
        np.setdiff1d(update.marginalise_landmarks, held) if held else update.marginalise_landmarks
    )


def own_arrays(tables: FactorTables) -> Arrays:
    """The users' factors for a file, if there ever were any. Raises InputError for code."""
    own = [(n, one) for n, one in sorted(tables.own_factors.items()) if tables.has_variables(one)]
    following = {"own_next": np.array(tables.next_own)} if tables.next_own else {}
    if not own:
        return following
    texts = [text_of(entry.factor, number) for number, entry in own]
    numbers = np.array([number for number, _ in own], np.int64)
    return {"own_factors": np.array(texts, np.str_), "own_factor_ids": numbers, **following}


def read_own(arrays: Arrays, tables: FactorTables) -> None:
    """Put the users' factors of a file into a graph. Raises InputError or ValueError."""
    texts = arrays.get("own_factors", np.zeros(0, np.str_)).tolist()
    for number, text in zip(arrays.get("own_factor_ids", no_ids()).tolist(), texts, strict=True):
        own = own_factor(factor_of(text))
        check_own_factor(own, tables, f"own factor {number}")
        tables.own_factors[number] = own
    following = max(tables.own_factors, default=-1) + 1  # older files do not say it
    tables.next_own = max(following, int(arrays.get("own_next", np.array(0))))
