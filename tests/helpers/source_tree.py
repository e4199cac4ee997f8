"""The package's source files: their module names, and what each imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from repository import ROOT

PACKAGE = "bmask_slam"
LAYERS = ("graph", "semantics", "mapping", "slam")
SOURCES = [path for layer in LAYERS for path in sorted((ROOT / layer).rglob("*.py"))]


def location(path: Path) -> str:
    """The path as seen from the repository, as messages show it."""
    return path.relative_to(ROOT).as_posix()


def module_name(path: Path) -> str:
    """The dotted name: ``bmask_slam.system`` for slam/system.py; other layers keep their folder."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    parts = parts[1:] if parts[0] == "slam" else parts
    return ".".join([PACKAGE, *parts]).removesuffix(".__init__")


PATHS = {module_name(path): path for path in SOURCES}


@cache
def parse(path: Path) -> ast.Module:
    """The syntax tree of a file."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file's syntax tree."""
    return tuple(ast.walk(parse(path)))


@cache
def imported_names(path: Path) -> tuple[tuple[str, str], ...]:
    """Every import as (module, name), name empty for a plain ``import module``.

    Imports inside functions and under ``if TYPE_CHECKING`` count; relative ones have a dot ahead.
    """
    found: list[tuple[str, str]] = []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            module = "." * node.level + (node.module or "")
            found += [(module, alias.name) for alias in node.names]
    return tuple(found)


@cache
def imported_modules(module: str) -> frozenset[str]:
    """The modules of the package that a module imports."""
    found = set()
    for target, name in imported_names(PATHS[module]):
        full = f"{target}.{name}"
        if full in PATHS:
            found.add(full)
        elif target in PATHS and (target, name) != (PACKAGE, "__version__"):
            found.add(target)
    return frozenset(found - {module})


def users_of_modules() -> dict[str, set[str]]:
    """For each module, those that import it, directly or by a name that its room passes on.

    A room's ``__init__`` is not a user of its own.
    """
    users: dict[str, set[str]] = {module: set() for module in PATHS}
    for module, path in PATHS.items():
        if not _is_room(module):
            for target, name in imported_names(path):
                for source in _sources_of(target, name):
                    users[source].add(module)
    return users


def _is_room(module: str) -> bool:
    return PATHS[module].name == "__init__.py"


def _sources_of(target: str, name: str) -> Iterator[str]:
    """The modules that a name imported from a module comes from."""
    if f"{target}.{name}" in PATHS:
        yield f"{target}.{name}"
    elif target in PATHS:
        yield target
        if _is_room(target):
            passed_on = imported_names(PATHS[target])
            yield from (m for m, passed in passed_on if passed == name and m in PATHS)
