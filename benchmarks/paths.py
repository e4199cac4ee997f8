"""Where the repository, its data and the pages with results lie."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
KITCHEN = SHARED / "redkitchen"
RESULTS = ROOT / "docs" / "results"
