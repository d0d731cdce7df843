"""The classifier two-sample test says of known pairs of distributions what theory says."""

import numpy as np
import pytest
from c2st import c2st
from scipy.stats import norm


# the best classifier of N(0, I) and N(shift e_1, I) is right in Phi(shift / 2) of cases
@pytest.mark.slow
@pytest.mark.parametrize(
    ("d", "shift"), [(2, 0.0), (2, 1.0), *(pytest.param(10, s, marks=pytest.mark.slow) for s in (0.0, 0.5, 1.0))]
)
def test_gaussians_are_told_apart_as_often_as_is_possible(d, shift):
    n = 2500 if d == 2 else 5000
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, n, d))
    b[:, 0] += shift
    # 2n rows: the accuracy's standard error is 0.5 / sqrt(2n) and the folds share rows; a classifier is not quite best
    assert c2st(a, b) == pytest.approx(norm.cdf(shift / 2), abs=3 * 0.5 / np.sqrt(2 * n) + 0.005)
