"""What a second thread prepares comes in order, and what nobody waits for is not prepared."""

from __future__ import annotations

import threading

import pytest

from bmask_slam.runtime.prefetch import AHEAD, prepared_ahead


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
