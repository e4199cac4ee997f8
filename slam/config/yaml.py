"""YAML text by the rules of YAML 1.2, where ``1e-3`` is a number and ``off`` is a text.

Read and written by ruamel.yaml, with three differences: a date is a text, as YAML 1.2 has it; a
list is written on one line; line breaks other than a newline are escaped.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.constructor import DuplicateKeyError, SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import ScalarNode, SequenceNode
from ruamel.yaml.representer import SafeRepresenter

from bmask_slam.graph.errors import InputError


class _Constructor(SafeConstructor):
    """Safe types, without dates."""


class _Representer(SafeRepresenter):
    """Lists on one line, and escapes where a plain text would not read back."""

    def represent_sequence(
        self, tag: Any, sequence: Any, flow_style: bool | None = None
    ) -> SequenceNode:
        return super().represent_sequence(tag, sequence, flow_style=True)

    def represent_scalar(
        self, tag: Any, value: Any, style: str | None = None, anchor: Any = None
    ) -> ScalarNode:
        escaped = any(c in value for c in "\x85\u2028\u2029")
        return super().represent_scalar(tag, value, '"' if escaped else style, anchor)


_Constructor.add_constructor("tag:yaml.org,2002:timestamp", SafeConstructor.construct_yaml_str)


def parse_yaml(text: str, source: str) -> Any:
    """One YAML document; ``source`` names it in the message.

    Raises:
        InputError: not YAML, or a key given twice; names the line.
    """
    reader = YAML(typ="safe", pure=True)
    reader.Constructor = _Constructor
    try:
        return reader.load(text)
    except MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        problem = (error.problem or "not a YAML text").partition(" with value")[0]
        cure = "; remove one of the two" if isinstance(error, DuplicateKeyError) else ""
        raise InputError(f"{source}{line}: {problem}{cure}") from error
    except (YAMLError, ValueError) as error:
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
    writer = YAML(typ="safe", pure=True)
    writer.Representer = _Representer
    writer.default_flow_style, writer.width = flow, 10**6 if flow else 100
    writer.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    out = io.StringIO()
    writer.dump(document, out)
    return out.getvalue().removesuffix("...\n").strip() if flow else out.getvalue()
