"""YAML that is written is read back unchanged."""

from __future__ import annotations

import pytest

from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml


@pytest.mark.parametrize("flow", [False, True])
@pytest.mark.parametrize("text", ["\x85", "a\u2028b", "\u2029", "two\nlines", "1e-3", "off", ""])
def test_ambiguous_texts_are_quoted_and_read_back(text: str, flow: bool) -> None:
    document = {"label": text, "list": [text, 1.5]}
    assert parse_yaml(format_yaml(document, flow), "here") == document
