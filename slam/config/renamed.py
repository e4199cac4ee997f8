"""Settings that older configuration files name differently."""

from __future__ import annotations

from typing import Any

RENAMED = {
    "dynamics": "moving_objects",
    "moving_objects.suspects": "static_verification",
    "feed": "factor_selection",
    "factor_selection.retire_batch": "marginalise_batch",
    "graph.max_recoveries": "max_repairs",
    "graph.bridge_sigma_rotation_rad": "anchor_sigma_rotation_rad",
    "graph.bridge_sigma_translation_m": "anchor_sigma_translation_m",
}
"""Present name of a key by the path of its older name; the groups before it are named as today."""


def with_present_names(tree: Any, prefix: str = "") -> Any:
    """A document with older names of settings replaced; not where the present name is given too."""
    if not isinstance(tree, dict):
        return tree
    found = {}
    for key, value in tree.items():
        name = RENAMED.get(f"{prefix}{key}", key)
        name = key if name in tree else name
        found[name] = with_present_names(value, f"{prefix}{name}.")
    return found
