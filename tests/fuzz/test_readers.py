"""Some seconds of `make fuzz`: no reader raises anything but InputError for a broken file."""

from __future__ import annotations

import ast
import logging
import os
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest
from engine import Reader, fuzz, inputs, table
from hypothesis import given, settings
from hypothesis import strategies as st
from readers import all_readers
from source_tree import SOURCES, location, nodes

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.yaml_file import format_yaml, parse_yaml

SECONDS, INPUTS = 8.0, 30


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


@pytest.fixture
def silent() -> Iterator[None]:
    logging.disable()
    yield
    logging.disable(logging.NOTSET)


def test_every_reader_refuses_broken_files(folder: Path, silent: None) -> None:
    readers = all_readers(folder / "good")
    each_s = SECONDS / len(readers)
    counts = [fuzz(r, folder / f"{k}", INPUTS, each_s) for k, r in enumerate(readers)]
    assert not any(count.faulty for count in counts), table(counts)
    assert all(count.inputs for count in counts)


READS = {
    *("read_text", "read_bytes", "imread", "fromfile", "safe_open", "load_file", "loadtxt"),
    *("json.loads", "json.load", "np.load", "torch.load", "csv.reader", "csv.DictReader", "YAML"),
}
LAST_NAMES = {name.rpartition(".")[2] for name in READS}
ELSEWHERE = {
    "semantics/weights/checkpoints.py": "torch's and safetensors' own readers, after a bounded one",
    "semantics/weights/light_weights.py": "whether a file says that it is one",
    "slam/job_process.py": "its own argument",
    "slam/dense/folder.py": "what it has just made",
    "slam/doctor/cameras.py": "/sys",
    "slam/doctor/machine.py": "/proc, /sys",
    "slam/doctor/packages.py": "what its own process prints",
    "slam/runtime/forked_process.py": "/proc",
    "slam/runtime/machine.py": "/proc",
    "slam/runtime/memory.py": "/proc",
    "slam/live/processes/worker.py": "/proc",
    "slam/reporting/page.py": "the project's own style",
}
"""Modules that read without graph/files, and what."""


def test_files_are_read_by_graph_files() -> None:
    found = set()
    for path in SOURCES:
        for node in nodes(path):
            if isinstance(node, ast.Call) and isinstance(node.func, (ast.Attribute, ast.Name)):
                last = node.func.id if isinstance(node.func, ast.Name) else node.func.attr
                if last not in LAST_NAMES:
                    continue
                name = ast.unparse(node.func)
                bounded = isinstance(node.func, ast.Name) and name in ("read_text", "read_bytes")
                if not bounded and READS & {name, last}:
                    found.add(location(path))
    found = {path for path in found if not path.startswith("graph/files/")}
    assert found == set(ELSEWHERE)


def crash(path: Path) -> None:
    os.kill(os.getpid(), 11)


def hang(path: Path) -> None:
    while True:
        pass


def large(path: Path) -> None:
    bytes(8 << 30)


def escape(path: Path) -> None:
    raise KeyError("x")


def refuse(path: Path) -> None:
    raise InputError("no")


@pytest.mark.parametrize(
    ("read", "words"),
    [(crash, "SIGSEGV"), (large, "MemoryError"), (escape, "KeyError at"), (refuse, "")],
)
def test_the_engine_sees(
    read: object, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUZZ_OUT", str(tmp_path / "kept"))
    count = fuzz(Reader("a", "a.txt", read, (b"abc",)), tmp_path, 3, 20.0)  # type: ignore[arg-type]
    assert count.inputs == 3
    assert (words in "".join(count.faults)) and bool(count.faults) == bool(words)
    assert count.faulty == (3 if words else 0)
    assert bool(words) == (tmp_path / "kept").is_dir()


def test_the_engine_sees_a_reader_that_takes_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FUZZ_OUT", str(tmp_path / "kept"))
    monkeypatch.setattr("engine.MAX_S", 0.2)
    count = fuzz(Reader("a", "a.txt", hang, (b"abc",)), tmp_path, 2, 20.0)
    (place,) = count.faults
    assert place.startswith("_HungError at")
    assert (count.inputs, count.faulty) == (2, 2)


def test_the_engine_sees_memory_that_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where a library hides that it could not have more."""
    monkeypatch.setenv("FUZZ_OUT", str(tmp_path / "kept"))
    monkeypatch.setattr("engine.MAX_BYTES", 50 << 20)
    reader = Reader("a", "a.txt", lambda path: b"1" * (100 << 20), (b"abc",))
    count = fuzz(reader, tmp_path, 3, 20.0)
    assert list(count.faults) == ["memory"]
    assert (count.inputs, count.faulty, count.accepted) == (3, 1, 2)


def test_the_same_seed_gives_the_same_inputs() -> None:
    def some(seed: int) -> list[bytes]:
        return list(islice(inputs(Reader("a", "a.txt", refuse, (b"abc 1.5\n",)), seed), 50))

    assert some(3) == some(3) != some(4)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**20), 10**20) | st.text()
    | st.floats(allow_nan=False),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)  # fmt: skip


@settings(max_examples=30, deadline=None, derandomize=True)
@given(PLAIN)
def test_documents_are_read_back(document: object) -> None:
    assert parse_yaml(format_yaml(document), "here") == document


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.text(max_size=60))
def test_any_text_is_a_document_or_one_error(text: str) -> None:
    try:
        parse_yaml(text, "here")
    except InputError as error:
        assert str(error).startswith("here")
