"""Wall time of the stages of a step."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, Protocol, TypeVar

P = ParamSpec("P")
R = TypeVar("R")


class Timed(Protocol):
    """What has stages: ``stage_ms`` is wall time in milliseconds by name."""

    stage_ms: dict[str, float]


T = TypeVar("T", bound=Timed)


def stage(name: str) -> Callable[[Callable[Concatenate[T, P], R]], Callable[Concatenate[T, P], R]]:
    """A method that is a stage of a step: its wall time is added to ``self.stage_ms[name]``."""

    def decorate(method: Callable[Concatenate[T, P], R]) -> Callable[Concatenate[T, P], R]:
        @wraps(method)
        def timed(self: T, *arguments: P.args, **named: P.kwargs) -> R:
            started_s = time.perf_counter()
            try:
                return method(self, *arguments, **named)
            finally:
                spent_ms = 1e3 * (time.perf_counter() - started_s)
                self.stage_ms[name] = self.stage_ms.get(name, 0.0) + spent_ms

        return timed

    return decorate
