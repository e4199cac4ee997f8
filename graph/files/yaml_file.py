"""YAML text by the rules of YAML 1.2, where ``1e-3`` is a number and ``off`` is a text.

Read and written by ruamel.yaml, with three differences: a date is a text, as YAML 1.2 has it; a
list is written on one line; line breaks other than a newline are escaped. A document that is read
has plain values only, and is bounded in size, depth and in what its aliases stand for.
"""

from __future__ import annotations

import io
from copy import deepcopy
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import ConstructorError, DuplicateKeyError, SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import read_bytes

MAX_BYTES = 1 << 18
MAX_DEPTH = 40
MAX_VALUES = 20_000
"""In a document, where an alias counts as all that it stands for."""
MAX_DIGITS = 100
"""Of a whole number, so that it is one that a float can have too."""
TAGS = ("map", "seq", "str", "int", "float", "bool", "null")
_CURE = "a YAML file was expected"
_UNREADABLE = (YAMLError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
"""What ruamel.yaml raises for texts that are not as their tags and signs promise."""


class _Constructor(SafeConstructor):
    """Plain values only, without dates; documents that are no larger than a file can be."""

    def construct_document(self, node: Node) -> Any:
        _measure(node, {})
        return super().construct_document(node)

    def construct_yaml_int(self, node: Any) -> int:
        if len(node.value) > MAX_DIGITS:
            problem = f"{node.value[:20]}... of {len(node.value)} digits is not a number"
            raise ConstructorError(None, None, problem, node.start_mark)
        return super().construct_yaml_int(node)


class _Representer(SafeRepresenter):
    """Lists on one line, and escapes where a plain text would not read back."""

    def represent_sequence(
        self, tag: Any, sequence: Any, flow_style: bool | None = None
    ) -> SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style=True)

    def represent_scalar(
        self, tag: Any, value: Any, style: str | None = None, anchor: Any = None
    ) -> ScalarNode:
        signs = value.startswith(("?", ":"))  # of a key and a value, within a list
        escaped = signs or any(c in value for c in "\x85\u2028\u2029")
        return super().represent_scalar(tag, value, '"' if escaped else style, anchor)


_TAG = "tag:yaml.org,2002:"
_Constructor.yaml_constructors = {
    **{f"{_TAG}{name}": getattr(_Constructor, f"construct_yaml_{name}") for name in TAGS},
    f"{_TAG}timestamp": SafeConstructor.construct_yaml_str,
    None: SafeConstructor.construct_undefined,
}


def _measure(node: Node, known: dict[int, tuple[int, int]]) -> tuple[int, int]:
    """Number of values in a node, and their depth. Raises ValueError if there are too many."""
    if id(node) not in known:
        known[id(node)] = MAX_VALUES, MAX_DEPTH  # where it holds itself
        children = [] if isinstance(node, ScalarNode) else node.value
        if isinstance(node, MappingNode):
            children = [part for pair in children for part in pair]
        sizes = [_measure(child, known) for child in children]
        count = 1 + sum(values for values, _ in sizes)
        depth = 1 + max((levels for _, levels in sizes), default=0)
        if count > MAX_VALUES or depth > MAX_DEPTH:
            raise ValueError(f"more than {MAX_VALUES} values, or nested more than {MAX_DEPTH} deep")
        known[id(node)] = count, depth
    return known[id(node)]


def parse_yaml(text: str, source: str) -> Any:
    """One YAML document; ``source`` names it in the message.

    Raises:
        InputError: not a text (where it stands in a file of another kind), not YAML, a key given
            twice, other values than plain ones, or a document that is too large; names the line if
            there is one.
    """
    if not isinstance(text, str):
        raise InputError(f"{source}: a YAML text was expected, not {type(text).__name__}")
    if len(text) > MAX_BYTES:
        raise InputError(f"{source}: {len(text)} characters, more than {MAX_BYTES}")
    try:
        return deepcopy(_parsed(text))
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = (error.problem or "not a YAML text").partition(" with value")[0]
        cure = "; remove one of the two" if isinstance(error, DuplicateKeyError) else ""
        raise InputError(f"{source}{line}: {problem}{cure}") from error
    except RecursionError as error:
        raise InputError(f"{source}: nested more than {MAX_DEPTH} deep") from error
    except _UNREADABLE as error:
        raise InputError(f"{source}: not a YAML text ({error})") from error


def read_yaml(file: Path) -> Any:
    """The document in a YAML file; an empty file is an empty mapping.

    Raises:
        InputError: no such file, not a text, or not YAML.
    """
    data = read_bytes(file, _CURE, MAX_BYTES)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not a text file; {_CURE}") from error
    document = parse_yaml(text, str(file))
    return {} if document is None else document


@lru_cache(maxsize=16)
def _parsed(text: str) -> Any:
    """The document of a text, not to be changed: a process reads the same ones, which takes long.

    Raises what ruamel.yaml raises.
    """
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = _Constructor
    return reader.load(text)


def format_yaml(document: Any, flow: bool = False) -> str:
    """YAML text of plain values in their own order; ``flow`` puts it on one line."""
    return _formatted(_Document(repr(document), document), flow)


@dataclass(frozen=True)
class _Document:
    """Plain values, which are compared by their ``text`` in Python."""

    text: str
    values: Any = field(compare=False)


@lru_cache(maxsize=8)
def _formatted(document: _Document, flow: bool) -> str:
    """Each checkpoint of a run holds the same configuration, whose YAML takes 0.1 s."""
    writer = YAML(typ="safe", pure=True)
    writer.Representer = _Representer
    writer.default_flow_style, writer.width = flow, 10**6 if flow else 100
    writer.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    out = io.StringIO()
    writer.dump(document.values, out)
    return out.getvalue().removesuffix("...\n").strip() if flow else out.getvalue()
