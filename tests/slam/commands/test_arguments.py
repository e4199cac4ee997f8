"""Segmenter options of the command line."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from bmask_slam.commands.arguments import add_segmenter_arguments, segmenter_options
from bmask_slam.labelling.config import SemanticsConfig

BASE = SemanticsConfig().segmenter


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_segmenter_arguments(parser, "light")
    return parser.parse_args(words)


def test_options_not_given_keep_their_values() -> None:
    assert segmenter_options(parsed(), BASE) == BASE


def test_files_are_given_by_their_absolute_paths() -> None:
    found = segmenter_options(parsed("--proposals", "yolox.onnx"), replace(BASE, min_score=0.3))
    assert found.proposals == Path("yolox.onnx").absolute()
    assert found.min_score == 0.3
