"""GTSAM keys of keyframes (x) and landmarks (l), and back from the text of its errors."""

from __future__ import annotations

import re

import numpy as np

from bmask_slam.graph.arrays import Ints

_INDEX_BITS = 56
KEYFRAME_BASE = ord("x") << _INDEX_BITS
LANDMARK_BASE = ord("l") << _INDEX_BITS
_NAMED = re.compile(r"(?:Symbol: |key \")([xl])(\d+)")
_NAMES = {"x": "keyframe", "l": "landmark"}


def keyframe_keys(ids: Ints) -> list[int]:
    """The keys of keyframes, as Python integers."""
    return (np.asarray(ids, np.int64) + KEYFRAME_BASE).tolist()


def landmark_keys(ids: Ints) -> list[int]:
    """The keys of landmarks, as Python integers."""
    return (np.asarray(ids, np.int64) + LANDMARK_BASE).tolist()


def variable_named_in(message: str) -> tuple[str, int] | None:
    """("keyframe" or "landmark", id) that an error text of GTSAM names, or None.

    The text is like ``near variable 7782220156096217121 (Symbol: l33)`` or
    ``Attempting to at the key "x1"``.
    """
    match = _NAMED.search(message)
    return None if match is None else (_NAMES[match[1]], int(match[2]))
