"""Configuration: nested frozen dataclasses, defaults < YAML file < ``--set a.b=c``.

The defaults live in the code, beside the class that they configure. This module only turns text
into such an object, checks every value against its field's type, and writes the result back.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from bmask_slam.config.yaml import format_yaml, parse_yaml, read_yaml
from bmask_slam.graph.data_files import data_path
from bmask_slam.graph.errors import InputError

Config = TypeVar("Config")


class _Given(NamedTuple):
    """A checked value and where it was given, for the messages."""

    value: Any
    source: str


def find_config(name: str) -> Path:
    """A YAML file from its path, or from the bare name of one in ``data/configs``."""
    if re.fullmatch(r"[\w-]+", name):
        return data_path("configs", f"{name}.yaml")
    return Path(name)


def resolve(
    cls: type[Config],
    file: Path | None = None,
    overrides: Sequence[str] = (),
    section: str | None = None,
) -> Config:
    """The configuration ``cls()`` with a file's values and then ``a.b=c`` overrides applied.

    Of the file only one ``section`` is looked at if it is given.

    Raises:
        InputError: an unreadable file, an unknown key, a value of the wrong type, or one that
            the class itself refuses (ValueError); names the dotted path, the value and the cure.
    """
    given: dict[str, _Given] = {}
    if file is not None:
        content = read_yaml(file)
        if section is not None and isinstance(content, dict):
            content = content.get(section) or {}
        given |= _flatten(cls, content, str(file))
    for text in overrides:
        path, separator, value = text.partition("=")
        if not separator or not path.strip():
            raise InputError(f"--set {text}: write it as key.subkey=value")
        source = f"--set {text}"
        tree: Any = parse_yaml(value, source)
        for key in reversed(path.strip().split(".")):
            tree = {key: tree}
        given |= _flatten(cls, tree, source)
    return _build(cls, None, given)


def from_tree(cls: type[Config], tree: Any, source: str) -> Config:
    """The configuration ``cls()`` with the values of a nested mapping; ``source`` names it.

    Raises:
        InputError: as `resolve`.
    """
    return _build(cls, None, _flatten(cls, tree, source))


def dump(config: Any) -> str:
    """YAML text of a resolved configuration; resolving it gives an equal configuration."""
    return format_yaml(_plain(config))


def differences(config: Any, other: Any) -> dict[str, Any]:
    """Plain values of ``config`` by dotted path where ``other``, of the same class, has another."""
    values, others = (dict(_leaves(_plain(c))) for c in (config, other))
    return {path: value for path, value in values.items() if value != others[path]}


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value that is no group of keys, by dotted path."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{path}{key}.")
        else:
            yield f"{path}{key}", value


def _plain(value: Any) -> Any:
    """A configuration value as what YAML can hold."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value) if f.init}
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


# --- From a tree of plain values to checked ones, by dotted path ---------------------------------


def _fields(cls: type) -> dict[str, Any]:
    """Name and resolved type of each field that the constructor takes."""
    hints = get_type_hints(cls)
    return {f.name: hints[f.name] for f in dataclasses.fields(cls) if f.init}


def _nested(hint: Any) -> type | None:
    """The dataclass in ``X`` or ``X | None``, or None."""
    options = [hint, *(get_args(hint) if _is_union(hint) else ())]
    return next((o for o in options if isinstance(o, type) and dataclasses.is_dataclass(o)), None)


def _is_union(hint: Any) -> bool:
    return get_origin(hint) in (Union, types.UnionType)


def _flatten(
    cls: type, tree: Any, source: str, prefix: str = "", root: type | None = None
) -> dict[str, _Given]:
    """Checked values of a nested mapping by dotted path from the root class."""
    root = root or cls
    if not isinstance(tree, Mapping):
        keys = ", ".join(f"{prefix}{name}" for name in _fields(cls))
        where = prefix.rstrip(".") or "the whole"
        raise InputError(f"{source}: {where} is a group of keys, not {tree!r}; there are: {keys}")
    given: dict[str, _Given] = {}
    fields = _fields(cls)
    for key, value in tree.items():
        path = f"{prefix}{key}"
        if key not in fields:
            raise InputError(f"{source}: unknown key {path}; {_suggestion(root, prefix, str(key))}")
        nested = _nested(fields[key])
        if nested is not None and nested is not fields[key] and value is None:
            given[path] = _Given(None, source)
        elif nested is None:
            given[path] = _Given(_check(value, fields[key], path, source), source)
        else:
            given |= _flatten(nested, value, source, f"{path}.", root)
    return given


def _paths(cls: type, prefix: str = "") -> Iterator[str]:
    """Every dotted path of a configuration class, groups before their members."""
    for name, hint in _fields(cls).items():
        yield f"{prefix}{name}"
        nested = _nested(hint)
        if nested is not None:
            yield from _paths(nested, f"{prefix}{name}.")


def _suggestion(root: type, prefix: str, key: str) -> str:
    """The cure for an unknown key: the closest of its group, else of all, else the group's keys."""
    every = list(_paths(root))
    siblings = [p for p in every if p.startswith(prefix) and "." not in p[len(prefix) :]]
    close = difflib.get_close_matches(prefix + key, siblings, 1, 0.7)
    if not close:
        by_name = {p.rpartition(".")[2]: p for p in reversed(every)}
        close = [by_name[n] for n in difflib.get_close_matches(key, by_name, 1, 0.7)]
    return f"did you mean {close[0]}?" if close else f"there are: {', '.join(siblings)}"


def _build(cls: type, base: Any, given: Mapping[str, _Given], prefix: str = "") -> Any:
    """``base`` (the defaults, or ``cls()``) with the given values of the group ``prefix``."""
    changes: dict[str, Any] = {}
    sources: list[str] = []
    for name, hint in _fields(cls).items():
        path = f"{prefix}{name}"
        if path in given:
            changes[name] = given[path].value
            sources.append(given[path].source)
        nested = _nested(hint)
        if nested is not None and any(p.startswith(f"{path}.") for p in given):
            inner = getattr(base if base is not None else cls(), name)
            changes[name] = _build(nested, inner, given, f"{path}.")
            sources += [g.source for p, g in given.items() if p.startswith(f"{path}.")]
    try:
        return cls(**changes) if base is None else dataclasses.replace(base, **changes)
    except ValueError as error:
        where = ", ".join(dict.fromkeys(sources)) or cls.__name__
        raise InputError(f"{where}: {prefix.rstrip('.') or cls.__name__}: {error}") from error


# --- One value against its type ------------------------------------------------------------------


def _check(value: Any, hint: Any, path: str, source: str) -> Any:
    """The value as its field's type, or InputError."""
    try:
        return _convert(value, hint)
    except _MismatchError:
        message = f"{source}: {path} = {format_yaml(value, flow=True)} is not {_describe(hint)}"
        raise InputError(message) from None


class _MismatchError(Exception):
    """A value that does not fit a type."""


def _convert(value: Any, hint: Any) -> Any:
    """The value as ``hint``: whole numbers are taken for floats, nothing else is converted."""
    arguments = get_args(hint)
    if _is_union(hint):
        return _first(value, arguments)
    if get_origin(hint) is tuple:
        return _convert_tuple(value, arguments)
    if get_origin(hint) is Literal:
        return _member(value, {argument: argument for argument in arguments})
    return _convert_plain(value, hint)


def _convert_plain(value: Any, hint: Any) -> Any:
    """The value as None, an enum's member, a number, a text or a path."""
    if hint is type(None):
        return _member(value, {None: None})
    if isinstance(hint, type) and issubclass(hint, Enum):
        return _member(value, {m.name: m for m in hint} | {m.value: m for m in hint})
    if hint not in (bool, int, float, str, Path):
        raise TypeError(f"a configuration field cannot be of type {hint}")
    if hint is float and type(value) is int:
        value = _as_float(value)
    if hint is Path and type(value) is str:
        value = Path(value)
    if not isinstance(value, hint) or (type(value) is bool and hint is not bool):
        raise _MismatchError
    if hint is float and math.isnan(value):  # infinity may switch a limit off
        raise _MismatchError
    return value


def _first(value: Any, hints: Sequence[Any]) -> Any:
    """The value as the first of several types that takes it unchanged, else with conversion."""
    fits = []
    for hint in hints:
        try:
            fits.append(_convert(value, hint))
        except _MismatchError:
            continue
    if not fits:
        raise _MismatchError
    return next((f for f in fits if type(f) is type(value)), fits[0])


def _member(value: Any, members: Mapping[Any, Any]) -> Any:
    """The member that equals the value and is of its type (1 is not True)."""
    for key, member in members.items():
        if type(key) is type(value) and key == value:
            return member
    raise _MismatchError


def _convert_tuple(value: Any, hints: tuple[Any, ...]) -> tuple[Any, ...]:
    """A list as ``tuple[X, Y]`` or ``tuple[X, ...]``."""
    if not isinstance(value, (list, tuple)):
        raise _MismatchError
    if hints[-1:] == (...,):
        hints = hints[:1] * len(value)
    if len(value) != len(hints):
        raise _MismatchError
    return tuple(_convert(item, hint) for item, hint in zip(value, hints, strict=True))


def _as_float(value: int) -> float:
    try:
        return float(value)
    except OverflowError:
        raise _MismatchError from None


_NAMES = {bool: "true or false", int: "a whole number", float: "a number", str: "a text (quote it)"}


def _describe(hint: Any) -> str:
    """What a user must write for a type."""
    arguments = get_args(hint)
    if _is_union(hint):
        return " or ".join(_describe(a) for a in arguments)
    if get_origin(hint) is Literal:
        return f"one of: {', '.join(str(a) for a in arguments)}"
    if get_origin(hint) is tuple:
        some = arguments[-1] is ...
        items = f"{_describe(arguments[0])}, ..." if some else ", ".join(map(_describe, arguments))
        return f"a list [{items}]"
    if hint is type(None):
        return "null"
    if issubclass(hint, Enum):
        return f"one of: {', '.join(str(m.value) for m in hint)}"
    return _NAMES.get(hint, "a path")
