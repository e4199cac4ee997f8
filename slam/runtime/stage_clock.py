"""Wall time of the stages of a step."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageClock:
    """Wall time of named stages in milliseconds; a stage may be entered again."""

    def __init__(self) -> None:
        self.stage_ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time what is done inside, under this name."""
        started_s = time.perf_counter()
        yield
        spent_ms = 1e3 * (time.perf_counter() - started_s)
        self.stage_ms[name] = self.stage_ms.get(name, 0.0) + spent_ms
