"""Configuration: nested frozen dataclasses, defaults < YAML file < ``--set a.b=c``.

The defaults live in the code, beside the class that they configure. Here the given values are
merged over them by dotted path, and pydantic checks the result against the types of the fields.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from enum import EnumType
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from pydantic import TypeAdapter, ValidationError

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.data_files import given_or_shipped
from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml, read_yaml

Config = TypeVar("Config")
EXPECTED = {
    "bool_type": "true or false",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "string_type": "a text (quote it)",
    "tuple_type": "a list",
}
"""What a user must write, by pydantic's type of the error."""
RENAMED = {
    "dynamics": "moving_objects",
    "moving_objects.suspects": "static_verification",
    "feed": "factor_selection",
    "mapping.local_keyframes": "local_map.keyframes",
    "mapping.local_min_shared": "local_map.min_shared",
    "factor_selection.retire_batch": "marginalise_batch",
    **{
        f"loops.{name}": f"noise.{name}"
        for name in ("drift_rad_per_m", "drift_m_per_m", "model_sigma_rad", "model_sigma_m")
    },
    "loops.model_share": "noise.model_share",
    "graph.max_recoveries": "max_repairs",
    "graph.bridge_sigma_rotation_rad": "anchor_sigma_rotation_rad",
    "graph.bridge_sigma_translation_m": "anchor_sigma_translation_m",
}
"""Present name of a setting, within its group, by its older path.

In the path the groups have their present names.
"""
REMOVED = {"features.octaves": (0, "features.layer_shares")}
"""Settings that are no more: the value that is still read, which is what is done now, and what
serves for others."""


def find_config(name: str) -> Path:
    """A YAML file from its path, or from the bare name of one in ``data/configs``."""
    return given_or_shipped(name, "configs")


def resolve(
    cls: type[Config],
    file: Path | None = None,
    overrides: Sequence[str] = (),
    section: str | None = None,
) -> Config:
    """The configuration ``cls()`` with a file's values and then ``a.b=c`` overrides applied.

    With ``section`` only this group of the file is read. Older names of settings are accepted in
    files (RENAMED).

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong type, or one that
            the class itself refuses (ValueError); names the dotted path, the value and the cure.
    """
    given = _GivenValues(cls)
    if file is not None:
        content = _with_present_names(read_yaml(file))
        if section is not None and isinstance(content, dict):
            content = content.get(section) or {}
        given.add(content, str(file))
    for text in overrides:
        path, separator, value = text.partition("=")
        if not separator or not path.strip():
            raise InputError(f"--set {text}: write it as key.subkey=value")
        tree: Any = parse_yaml(value, f"--set {text}")
        for key in reversed(path.strip().split(".")):
            tree = {key: tree}
        given.add(tree, f"--set {text}")
    return given.build()


def from_tree(cls: type[Config], tree: Any, source: str) -> Config:
    """The configuration ``cls()`` with the values of a nested mapping; ``source`` names it.

    Raises:
        InputError: as `resolve`.
    """
    given = _GivenValues(cls)
    given.add(tree, source)
    return given.build()


def from_text(cls: type[Config], text: str, source: str) -> Config:
    """The configuration that `dump` wrote as ``text``, today or before settings were renamed.

    Raises:
        InputError: as `resolve`.
    """
    return from_tree(cls, _with_present_names(parse_yaml(text, source)), source)


def dump(config: Any) -> str:
    """YAML text of a resolved configuration; resolving it gives an equal configuration."""
    return format_yaml(_plain(config))


def differences(config: Any, other: Any) -> dict[str, Any]:
    """Plain values of ``config`` by dotted path where ``other``, of the same class, has another."""
    values, others = (dict(_leaves(_plain(c))) for c in (config, other))
    return {path: value for path, value in values.items() if value != others[path]}


def _with_present_names(tree: Any, prefix: str = "") -> Any:
    """A document with older names of settings replaced; not where the present name is given too."""
    if not isinstance(tree, dict):
        return tree
    found, moved = dict[str, Any](), dict[str, str]()
    for key, value in tree.items():
        if value == REMOVED.get(f"{prefix}{key}", (...,))[0]:
            continue
        name = str(RENAMED.get(f"{prefix}{key}", key))
        if "." in name:
            moved[key] = name
        else:
            name = key if name in tree else name
            found[name] = _with_present_names(value, f"{prefix}{name}.")
    for key, name in moved.items():
        group, _, within = name.rpartition(".")
        target = found.setdefault(group, {})
        fits = isinstance(target, dict) and within not in target
        value = _with_present_names(tree[key], f"{prefix}{name}.")
        (target if fits else found)[within if fits else key] = value
    return found


def _plain(config: Any) -> Any:
    """A configuration as nested mappings of what YAML can hold."""
    cls: Any = type(config)
    return _adapter(cls).dump_python(config, mode="json")


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no group of keys, by dotted path."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


# --- From trees of plain values to a checked configuration ---------------------------------------


@cache
def _adapter(cls: type) -> TypeAdapter[Any]:
    return TypeAdapter(cls)


@cache
def _fields(cls: Any) -> dict[str, Any]:
    """Name and resolved type of each field that the constructor takes."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def _nested(hint: Any) -> Any:
    """The dataclass in ``X`` or ``X | None``, or None."""
    return next((h for h in (hint, *get_args(hint)) if dataclasses.is_dataclass(h)), None)


class _GivenValues:
    """The values given for a configuration, merged over the defaults of the groups they are in."""

    def __init__(self, cls: type) -> None:
        self._cls = cls
        self._tree: dict[str, Any] = {}
        self._sources: dict[str, str] = {}  # where each value was given, by dotted path

    def add(self, tree: Any, source: str) -> None:
        """Merge a nested mapping; its values replace those given before. Raises InputError."""
        self._add(self._cls, self._tree, tree, source, "")

    def build(self) -> Any:
        """The configuration. Raises InputError for a value that does not fit."""
        try:  # as JSON, where pydantic's strict types take a list as a tuple and a text as a path
            return _adapter(self._cls).validate_json(json.dumps(self._tree), strict=True)
        except ValidationError as error:
            raise InputError(_refusal(error.errors()[0], self._sources, self._cls)) from error

    def _add(self, cls: Any, merged: dict[str, Any], tree: Any, source: str, prefix: str) -> None:
        if not isinstance(tree, Mapping):
            keys = ", ".join(f"{prefix}{name}" for name in _fields(cls))
            where = prefix.rstrip(".") or "the whole"
            raise InputError(
                f"{source}: {where} is a group of keys, not {str(tree)[:40]!r}; there are: {keys}"
            )
        for key, value in tree.items():
            path, hint = f"{prefix}{key}", _fields(cls).get(key)
            if hint is None:
                cure = _suggestion(self._cls, prefix, str(key))
                raise InputError(f"{source}: unknown key {path}; {cure}")
            nested = _nested(hint)
            if nested is None or (value is None and nested is not hint):
                merged[key] = _checked(value, hint, f"{source}: {path}")
                if _is_below_zero(value, _default(cls, key)):
                    raise InputError(f"{source}: {path} = {value} is negative; give 0 or more")
                self._sources[path] = source
            else:
                if merged.get(key) is None:
                    merged[key] = _default(cls, key)
                self._add(nested, merged[key], value, source, f"{path}.")


def _checked(value: Any, hint: Any, where: str) -> Any:
    """The value, if it is not NaN or too large for a float; of an enum's name its value."""
    for item in value if isinstance(value, list) else [value]:
        too_large = isinstance(item, int) and abs(item) > sys.float_info.max
        if too_large or (isinstance(item, float) and math.isnan(item)):
            raise InputError(f"{where} = {format_yaml(value, flow=True)} is not a number")
    if isinstance(hint, EnumType) and isinstance(value, str) and value in hint.__members__:
        return hint[value].value
    return value


def _is_below_zero(value: Any, default: Any) -> bool:
    """Whether a whole number is negative; those whose default is above 0 count something."""
    return all(isinstance(n, int) for n in (value, default)) and value < 0 < default


def _default(cls: Any, name: str) -> Any:
    """Plain values of a group's default, {} where it has none."""
    field = next(f for f in dataclasses.fields(cls) if f.name == name)
    value = None if field.default is dataclasses.MISSING else field.default
    if field.default_factory is not dataclasses.MISSING:
        value = field.default_factory()
    return {} if value is None else _plain(value)


# --- Messages ------------------------------------------------------------------------------------


def _paths(cls: Any, prefix: str = "") -> Iterator[str]:
    """Every dotted path of a configuration class, groups before their members."""
    for name, hint in _fields(cls).items():
        yield f"{prefix}{name}"
        nested = _nested(hint)
        if nested is not None:
            yield from _paths(nested, f"{prefix}{name}.")


def _suggestion(root: Any, prefix: str, key: str) -> str:
    """The cure for an unknown key: the closest of its group, else of all, else the group's keys."""
    every = list(_paths(root))
    if present := RENAMED.get(f"{prefix}{key}"):
        return f"it is called {prefix}{present} now"
    if removed := REMOVED.get(f"{prefix}{key}"):
        return f"it is no more, see {removed[1]}"
    siblings = [p for p in every if p.startswith(prefix) and "." not in p[len(prefix) :]]
    close = difflib.get_close_matches(prefix + key, siblings, 1, 0.7)
    if not close:
        by_name = {p.rpartition(".")[2]: p for p in reversed(every)}
        close = [by_name[n] for n in difflib.get_close_matches(key, by_name, 1, 0.7)]
    return f"did you mean {close[0]}?" if close else f"there are: {', '.join(siblings)}"


def _refusal(error: Mapping[str, Any], sources: Mapping[str, str], cls: type) -> str:
    """One line for an error that pydantic found: where it was given, path, value and cure."""
    path = "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in error["loc"])[1:]
    group = f"{path.partition('[')[0]}.".lstrip(".")
    concerned = [
        s for p, s in sources.items() if f"{p}.".startswith(group) or group.startswith(f"{p}.")
    ]
    where = ", ".join(dict.fromkeys(concerned)) or cls.__name__
    kind, context = error["type"], error.get("ctx", {})
    if kind == "value_error":
        return f"{where}: {path or cls.__name__}: {context['error']}"
    if kind == "missing":
        return f"{where}: {path} is missing"
    value = f"{where}: {path} = {format_yaml(error['input'], flow=True)}"
    if kind in EXPECTED:
        return f"{value} is not {EXPECTED[kind]}"
    if "expected" in context:
        return f"{value} is not one of: {context['expected']}"
    return f"{value}: {error['msg']}"
