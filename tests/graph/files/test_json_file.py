"""JSON from untrusted files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.json_file import read_json


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "not JSON"),
        (b"{", "not JSON"),
        (b"[" * 200_000, "not JSON"),
        (b'{"a": "\xff"}', "not JSON"),
        (b"[1]", "should be an object"),
        (b'{"a": "one"}', "a: input should be a valid integer, found 'one'"),
        (b'{"a": ' + b"9" * 6000 + b"}", "not JSON"),
    ],
)
def test_what_is_not_as_it_should_be_is_one_line(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "settings.json"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"settings\.json: ") as caught:
        read_json(path, dict[str, int], "make it again")
    assert words in str(caught.value)
    assert str(caught.value).endswith("; make it again")
    assert len(str(caught.value)) < 500


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no such file; make it"):
        read_json(tmp_path / "none.json", dict[str, Any], "make it")
