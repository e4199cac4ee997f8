"""JSON from elsewhere, checked against a schema before anything uses it; and results as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, cast

import numpy as np
from pydantic import ConfigDict, StringConstraints, TypeAdapter, ValidationError

from bmask_slam.graph.errors import InputError, naming
from bmask_slam.graph.files.reading import read_bytes

Name = Annotated[str, StringConstraints(min_length=1, max_length=200)]
"""A name of a class or the like."""
STRICT = ConfigDict(strict=True, allow_inf_nan=False, extra="ignore", frozen=True)
"""Of models: numbers are finite, and nothing is converted from another type but whole to float."""
Content = TypeVar("Content")


def read_json(path: Path, schema: type[Content], cure: str) -> Content:
    """The content of a file, checked against ``schema``: any type that pydantic knows.

    Raises:
        InputError: a missing or very large file, no JSON, or not what the schema asks for; the line
            names the file, the field, the value and the ``cure``.
    """
    return parse_json(read_bytes(path, cure), schema, str(path), cure)


def parse_json(data: bytes | str, schema: type[Content], where: str, cure: str) -> Content:
    """JSON that stands in a file, checked as by ``read_json``; ``where`` names it. InputError."""
    try:
        return _adapter(cast("Any", schema)).validate_json(data, strict=True)
    except ValidationError as error:
        raise InputError(f"{where}: {first_problem(error)}; {cure}") from error


def check_json(value: Any, schema: type[Content], where: str, cure: str) -> Content:
    """A value of JSON that was parsed already, checked against ``schema``. Raises InputError."""
    try:
        with naming(where, cure):  # a dataclass may check itself
            return _adapter(cast("Any", schema)).validate_python(value)
    except ValidationError as error:
        raise InputError(f"{where}: {first_problem(error)}; {cure}") from error


def format_json(value: object) -> str:
    """A result as JSON: dataclasses by their fields, arrays as lists, what is not finite null."""
    return json.dumps(_plain(value), indent=1, default=str)


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    elif isinstance(value, Enum):
        value = value.value
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def first_problem(error: ValidationError) -> str:
    """The first problem in the reader's words: where it is, what is wrong, what was found."""
    found = error.errors(include_url=False)[0]
    if found["type"] == "json_invalid":
        return f"not JSON ({found['msg'].removeprefix('Invalid JSON: ')})"
    where = ".".join(str(part) for part in found["loc"])[:100]
    value = "" if found["type"] == "missing" else f", found {repr(found['input'])[:60]}"
    return f"{where or 'content'}: {found['msg'][0].lower()}{found['msg'][1:200]}{value}"


@cache
def _adapter(schema: Any) -> TypeAdapter[Any]:
    return TypeAdapter(schema)
