"""What a command lets be loaded before its own modules: only what its processes will need."""

from __future__ import annotations

import importlib

import pytest

from bmask_slam.cli import make_parser
from bmask_slam.commands.run import _load_ahead
from bmask_slam.parallel import loading_ahead
from bmask_slam.parallel.loading_ahead import NETWORK, WORKERS


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, ...]]:
    found: list[tuple[str, ...]] = []
    monkeypatch.setattr(loading_ahead, "load_ahead", lambda *modules: found.append(modules))
    monkeypatch.setattr(loading_ahead, "available_cores", lambda: 2)
    return found


@pytest.mark.parametrize(
    ("words", "modules"),
    [
        (["office"], [NETWORK]),
        (["office", "--segmenter", "light", "--set", "features.bucket_px=36"], [NETWORK]),
        (["office", "--parallel"], [WORKERS]),
        (["office", "--segmenter", "none"], []),
        (["office", "--segmenter", "truth"], []),
        (["office", "--set", "semantics.segmenter.name=none"], []),
        (["office", "--config", "paper"], []),
        (["office", "--localise", "map"], []),
        (["--resume", "run"], []),
    ],
)
def test_modules_by_the_words_of_a_run(
    words: list[str], modules: list[tuple[str, ...]], asked: list[tuple[str, ...]]
) -> None:
    _load_ahead(make_parser().parse_args(["run", *words]))
    assert asked == modules


def test_one_core_loads_the_network_in_its_own_process(
    asked: list[tuple[str, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loading_ahead, "available_cores", lambda: 1)
    _load_ahead(make_parser().parse_args(["run", "office"]))
    assert not asked


@pytest.mark.parametrize("module", [*WORKERS, *NETWORK])
def test_the_modules_exist(module: str) -> None:
    pytest.importorskip("torch")
    importlib.import_module(module)
