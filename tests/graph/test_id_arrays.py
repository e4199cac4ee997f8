"""Ids that are told apart, and numbered, as numpy does it."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from bmask_slam.graph.arrays import distinct, no_ids, numbered

FEW = st.lists(st.integers(0, 40), max_size=200)
FAR = st.lists(st.integers(-(2**40), 2**40), max_size=50)


@given(st.one_of(FEW, FAR))
def test_distinct_and_numbered_are_as_numpy_has_them(values: list[int]) -> None:
    ids = np.array(values, np.int64)
    names, places = np.unique(ids, return_inverse=True)
    for found in (distinct(ids), numbered(ids)[0]):
        assert found.dtype == np.int64
        np.testing.assert_array_equal(found, names)
    np.testing.assert_array_equal(numbered(ids)[1], places)


def test_of_no_ids_there_are_none() -> None:
    assert not len(distinct(no_ids()))
    assert [len(part) for part in numbered(no_ids())] == [0, 0]
