"""GTSAM keys of keyframes (x) and landmarks (l), and back from the text of its errors."""

from __future__ import annotations

import re
from collections.abc import Iterable

import numpy as np

from bmask_slam.graph.arrays import Ints
from bmask_slam.graph.errors import InputError

_INDEX_BITS = 56
KEYFRAME_BASE = ord("x") << _INDEX_BITS
LANDMARK_BASE = ord("l") << _INDEX_BITS
ROOT_BASE = ord("r") << _INDEX_BITS
"""Of the points at the root of a long map's tree; between landmarks and velocities."""
VELOCITY_BASE = ord("v") << _INDEX_BITS
_NAMED = re.compile(r"(?:Symbol: |key \")([xl])(\d+)")
_NAMES = {"x": "keyframe", "l": "landmark"}


def keyframe_keys(ids: Ints) -> list[int]:
    """The keys of keyframes, as Python integers."""
    return (np.asarray(ids, np.int64) + KEYFRAME_BASE).tolist()


def landmark_keys(ids: Ints) -> list[int]:
    """The keys of landmarks, as Python integers."""
    return (np.asarray(ids, np.int64) + LANDMARK_BASE).tolist()


def key_of_keyframe(keyframe_id: int) -> int:
    """The key of a keyframe's pose, T_world_camera, in GTSAM: ``gtsam.symbol("x", id)``."""
    return KEYFRAME_BASE + keyframe_id


def key_of_landmark(landmark_id: int) -> int:
    """The key of a landmark's point in the world, in GTSAM: ``gtsam.symbol("l", id)``."""
    return LANDMARK_BASE + landmark_id


def variables_of_keys(keys: Iterable[int]) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Ids of the keyframes and of the landmarks among keys. Raises InputError for other keys."""
    found: dict[int, list[int]] = {KEYFRAME_BASE: [], LANDMARK_BASE: []}
    for key in keys:
        base = key >> _INDEX_BITS << _INDEX_BITS
        if base not in found:
            raise InputError(
                f"add_factor: key {key} is no keyframe's and no landmark's; use "
                "key_of_keyframe(id) or key_of_landmark(id)"
            )
        found[base].append(key - base)
    return tuple(found[KEYFRAME_BASE]), tuple(found[LANDMARK_BASE])


def variable_named_in(message: str) -> tuple[str, int] | None:
    """("keyframe" or "landmark", id) that an error text of GTSAM names, or None.

    The text is like ``near variable 7782220156096217121 (Symbol: l33)`` or
    ``Attempting to at the key "x1"``.
    """
    match = _NAMED.search(message)
    return None if match is None else (_NAMES[match[1]], int(match[2]))
