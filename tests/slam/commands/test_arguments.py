"""Segmenter options of the command line."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import pytest

from bmask_slam.commands.arguments import (
    add_config_arguments,
    add_segmenter_arguments,
    chosen_config,
    segmenter_options,
)
from bmask_slam.commands.map import _masks
from bmask_slam.labelling.config import SemanticsConfig

BASE = SemanticsConfig().segmenter


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_segmenter_arguments(parser, "light")
    add_config_arguments(parser)
    return parser.parse_args(words)


def test_options_not_given_keep_their_values() -> None:
    assert segmenter_options(parsed(), BASE) == BASE


def test_files_are_given_by_their_absolute_paths() -> None:
    found = segmenter_options(parsed("--proposals", "yolox.onnx"), replace(BASE, min_score=0.3))
    assert found.proposals == Path("yolox.onnx").absolute()
    assert found.min_score == 0.3


def test_a_label_set_is_a_file_or_the_name_of_a_shipped_one(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mine.txt", "coco"):
        (tmp_path / name).write_text("chair\n")
    assert segmenter_options(parsed("--labels", "mine.txt"), BASE).labels == f"{tmp_path}/mine.txt"
    assert segmenter_options(parsed("--labels", "coco"), BASE).labels == "coco"


@pytest.mark.parametrize(
    "words",
    [["--segmenter", BASE.name], ["--segmenter", "truth"], ["--labels", "coco"]],
)
def test_what_is_given_counts_as_given_where_it_is_the_default(words: list[str]) -> None:
    assert not chosen_config(parsed(*words)).is_default
    assert chosen_config(parsed()).is_default


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ([], None),
        (["--weights", "w"], "light"),
        (["--masks", "m"], "precomputed"),
        (["--ray", "auto"], "light"),
        (["--proposals", "p.onnx"], "light"),
        (["--labels", "coco"], "light"),
        (["--segmenter", "truth", "--ray", "auto"], "truth"),
    ],
)
def test_a_map_takes_no_option_of_a_segmenter_without_one(words: list[str], name: str) -> None:
    """They did not count where neither --segmenter, --masks nor --weights was given."""
    found = _masks(parsed(*words))
    assert (found and found.name) == name
