"""The chi-square quantile that checks use."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from bmask_slam.graph.factors.checks import chi2_quantile


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.999])
def test_quantiles_equal_scipys_to_the_last_bit(probability: float) -> None:
    degrees = np.array([1, 2, 3, 6])
    np.testing.assert_array_equal(
        chi2_quantile(probability, degrees), chi2.ppf(probability, degrees)
    )
    assert chi2_quantile(probability, 3) == chi2.ppf(probability, 3)
