"""Paths of the checkout and of the data for tests."""

from __future__ import annotations

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
KITCHEN = SHARED / "redkitchen"


def shared(name: str) -> Path:
    """A file or folder of the data beside the checkout; a test that needs one is skipped without.

    The data (docs/data.md says where each set comes from) is not part of the project.
    """
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"no ../shared/data/{name} here")
    return path
