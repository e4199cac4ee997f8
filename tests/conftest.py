"""What holds for all tests."""

from __future__ import annotations

from bmask_slam.labelling import semantic_mapper as semantic_mapping


def pytest_configure() -> None:
    """Runs are without a segmenter where a test does not ask for one.

    A network in each would take minutes; what a user gets is tested in processes of their own.
    """
    semantic_mapping.DEFAULT_SEGMENTER = "none"
