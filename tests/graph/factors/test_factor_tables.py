"""The tables of factors: measurements that are replaced."""

from __future__ import annotations

import numpy as np

from bmask_slam.graph.arrays import Array
from bmask_slam.graph.factors.factor_tables import ObservationTable
from bmask_slam.graph.factors.graph_update import Observations

LANDMARKS = np.array([4, 7, 9])


def seen(landmarks: Array, measurements: Array) -> Observations:
    """What keyframe 3 observes; sigmas of the disparity are known where there is depth."""
    sigmas = np.where(np.isfinite(measurements), 1.0, np.nan)
    return Observations(np.full(len(landmarks), 3), landmarks, measurements, sigmas)


def measured(table: ObservationTable) -> Array:
    return table.all().measurements


def filled() -> ObservationTable:
    table = ObservationTable()
    table.add(seen(LANDMARKS, np.array([[10.0, 20, 5], [30, 40, np.nan], [50, 60, 45]])))
    return table


def test_measurements_are_replaced_and_unknown_observations_passed_over() -> None:
    table = filled()
    table.remeasure(seen(np.array([9, 8]), np.array([[51.0, 61, 46], [1, 2, 3]])))
    np.testing.assert_array_equal(measured(table)[[0, 2]], [[10, 20, 5], [51, 61, 46]])
    assert len(table) == 3


def test_of_two_keypoints_that_observe_a_landmark_the_nearer_is_meant() -> None:
    twice = np.array([[10.5, 20, 5.5], [300, 20, 290]])
    for order in ([0, 1], [1, 0]):
        table = filled()
        table.remeasure(seen(np.array([4, 4]), twice[order]))
        np.testing.assert_array_equal(measured(table)[0], twice[0])


def test_an_observation_without_depth_gets_none_but_may_lose_it() -> None:
    """Its sigma is not known: a factor with depth would have no finite cost."""
    table = filled()
    table.remeasure(seen(LANDMARKS[:2], np.array([[11.0, 21, np.nan], [31, 41, 25]])))
    np.testing.assert_array_equal(measured(table)[0], [11, 21, np.nan])
    np.testing.assert_array_equal(measured(table)[1], [30, 40, np.nan])
