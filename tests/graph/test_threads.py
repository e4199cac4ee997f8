"""Several threads work at the same time, and what they make keeps its order."""

from __future__ import annotations

import threading

import pytest

from bmask_slam.graph.threads import THREADS, in_threads


def test_several_threads_work_at_the_same_time_and_results_keep_their_order() -> None:
    meeting = threading.Barrier(THREADS, timeout=20)

    def square(number: int) -> int:
        meeting.wait()  # passes only where as many threads work at the same time
        return number**2

    numbers = range(6 * THREADS)
    assert in_threads(square, numbers) == [k**2 for k in numbers]


def test_an_exception_in_one_of_several_threads_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        in_threads(lambda number: 1 / number, [2, 1, 0, 4])
