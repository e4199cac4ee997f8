"""What other threads do comes in order, and what nobody waits for is not begun."""

from __future__ import annotations

import threading

import pytest

from bmask_slam.runtime.prefetch import AHEAD, THREADS, in_threads, prepared_ahead


def test_results_come_in_order_from_a_second_thread() -> None:
    threads = set()

    def square(number: int) -> int:
        threads.add(threading.current_thread())
        return number**2

    assert list(prepared_ahead(square, range(20))) == [(k, k**2) for k in range(20)]
    assert len(threads) == 1 and threading.current_thread() not in threads


def test_an_exception_is_raised_where_its_result_would_come() -> None:
    results = prepared_ahead(lambda number: 1 / number, [2, 1, 0, 4])
    assert [next(results), next(results)] == [(2, 0.5), (1, 1.0)]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_who_stops_early_waits_for_no_more_than_what_was_begun() -> None:
    prepared = []
    results = prepared_ahead(prepared.append, range(1000))
    next(results)
    results.close()
    assert 1 <= len(prepared) <= AHEAD + 2


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
