"""Segmenter options of the command line."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from bmask_slam.commands.arguments import add_segmenter_arguments, segmenter_options
from bmask_slam.labelling.config import SemanticsConfig
from bmask_slam.semantics.segmenters.segmenter_table import SegmenterOptions

BASE = SemanticsConfig().segmenter


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_segmenter_arguments(parser, "light")
    return parser.parse_args(words)


def test_options_not_given_keep_their_values() -> None:
    assert segmenter_options(parsed(), BASE) == BASE


def test_weak_detections_in_proposals_vote_only_if_configured() -> None:
    given = parsed("--proposals", "yolox.onnx")
    found = segmenter_options(given, BASE)
    assert found.proposals == Path("yolox.onnx").absolute()
    assert BASE.min_score < found.min_score == SemanticsConfig().object_score
    configured = replace(BASE, min_score=0.3)
    assert segmenter_options(given, configured).min_score == 0.3
    assert segmenter_options(given, SegmenterOptions(min_score=0.0)).min_score == 0.0
