"""Statistics that a few outliers do not change."""

import numpy as np
import pytest
from scipy.stats import norm

from turbrestore.core.robust import MEDIAN_DEVIATION, bisquare_weights, robust_scale


def test_the_scale_is_the_deviation_of_normal_numbers_and_ignores_outliers():
    assert pytest.approx(1 / norm.ppf(0.75), rel=1e-4) == MEDIAN_DEVIATION
    values = np.random.default_rng(0).normal(0, 3, 20000)
    values[:2000] = 1e6
    assert robust_scale(values) == pytest.approx(3, rel=0.2)
    assert robust_scale(np.zeros(0)) == 0


def test_weights_fall_from_one_to_zero():
    weights = bisquare_weights(np.array([0.0, 1.0, -1.0, 5.0, 100.0]), 1.0)
    assert weights[0] == 1 and weights[1] == weights[2] == pytest.approx((1 - 1 / 4.685**2) ** 2)
    assert not weights[3:].any()
    assert bisquare_weights(np.zeros(2), 0.0).tolist() == [1, 1]
