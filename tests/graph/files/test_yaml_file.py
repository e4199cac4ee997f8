"""YAML that is written is read back unchanged."""

from __future__ import annotations

from typing import Any

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml


@pytest.mark.parametrize("flow", [False, True])
@pytest.mark.parametrize(
    "text", ["\x85", "a\u2028b", "\u2029", "two\nlines", "1e-3", "off", "", "?0", ":a"]
)
def test_ambiguous_texts_are_quoted_and_read_back(text: str, flow: bool) -> None:
    document = {"label": text, "list": [text, 1.5]}
    assert parse_yaml(format_yaml(document, flow), "here") == document


@pytest.mark.parametrize("value", [[], {"a": 1}, None, 4, b"a: 1"])
def test_values_that_are_no_text_are_refused(value: Any) -> None:
    with pytest.raises(InputError, match="map: a YAML text was expected"):
        parse_yaml(value, "map")
