"""Paths of the checkout and of the data for tests."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared" / "data"
KITCHEN = SHARED / "redkitchen"
