"""YAML text by the rules of YAML 1.2, where ``1e-3`` is a number and ``off`` is a word.

PyYAML reads YAML 1.1: there ``1e-3`` is a text, ``off`` is false, ``010`` is eight and ``1:30`` is
ninety, and a key given twice is taken without a word. None of it suits configuration files.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

from bmask_slam.graph.errors import InputError

_INT = re.compile(r"[-+]?[0-9]+$")
_FLOAT = re.compile(
    r"([-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))$"
)
_BOOL = re.compile(r"(true|True|TRUE|false|False|FALSE)$")
_NULL = re.compile(r"(~|null|Null|NULL|)$")
_TAG = "tag:yaml.org,2002:"


class _Loader(yaml.SafeLoader):
    """SafeLoader with YAML 1.2's scalars, refusing a key that is given twice."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own name

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for position, key in enumerate(keys):
            if key in keys[:position]:
                mark = node.value[position][0].start_mark
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", mark
                )
        return super().construct_mapping(node, deep)


class _Dumper(yaml.SafeDumper):
    """SafeDumper whose plain scalars read back under the same rules; lists are on one line."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012 - PyYAML's own name

    def represent_sequence(
        self, tag: str, sequence: Any, flow_style: bool | None = None
    ) -> yaml.SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style=True)

    def represent_scalar(self, tag: str, value: str, style: str | None = None) -> yaml.ScalarNode:
        escaped = any(c in value for c in "\x85\u2028\u2029")  # line breaks, unless escaped
        return super().represent_scalar(tag, value, '"' if escaped else style)


def _construct_int(loader: _Loader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


for _class in (_Loader, _Dumper):
    _class.add_implicit_resolver(f"{_TAG}int", _INT, list("-+0123456789"))
    _class.add_implicit_resolver(f"{_TAG}float", _FLOAT, list("-+0123456789."))
    _class.add_implicit_resolver(f"{_TAG}bool", _BOOL, list("tTfF"))
    _class.add_implicit_resolver(f"{_TAG}null", _NULL, ["~", "n", "N", ""])
_Loader.add_constructor(f"{_TAG}int", _construct_int)


def parse_yaml(text: str, source: str) -> Any:
    """One YAML document; ``source`` names it in the message.

    Raises:
        InputError: not YAML, or a key given twice; names the line.
    """
    try:
        return yaml.load(text, _Loader)
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise InputError(f"{source}{line}: {error.problem}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{source}: not a YAML text: {error}") from error


def read_yaml(file: Path) -> Any:
    """The document in a YAML file; an empty file is an empty mapping.

    Raises:
        InputError: no such file, not a text, or not YAML.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except OSError as error:
        raise InputError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{file}: not a text file; a YAML file was expected") from error
    document = parse_yaml(text, str(file))
    return {} if document is None else document


def format_yaml(document: Any, flow: bool = False) -> str:
    """YAML text of plain values in their own order; ``flow`` puts it on one line."""
    text = yaml.dump(
        document,
        Dumper=_Dumper,
        sort_keys=False,
        allow_unicode=True,
        width=100 if not flow else 10**6,
        default_flow_style=flow,
    )
    return text.removesuffix("...\n").strip() if flow else text
