"""What start states and known parameters hide of a candidate's column, on small matrices."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.fitter import Fit
from bayessim_mjx.diagnosis.selection.screen import Projection


def test_where_no_known_parameter_is_free_only_start_states_are_projected_out():
    """All of them at the ends of their ranges, or none there: a column loses what the start states explain."""
    rng = np.random.default_rng(4)
    r, B, spread = rng.normal(size=(3, 20)), rng.normal(size=(3, 20, 2)), np.full(2, 1e6)
    fit = Fit((), np.zeros(0), np.zeros((3, 2)), r, np.zeros((3, 20, 0)), B, np.ones(3), 0.0, spread=spread)
    column = rng.normal(size=(3, 20))
    s, g, norm, projected = Projection(fit).moments(column)
    left = [a - b @ np.linalg.lstsq(b, a, rcond=None)[0] for a, b in zip(column, B, strict=True)]
    np.testing.assert_allclose(projected, left, atol=1e-6)
    assert s == pytest.approx(norm) == pytest.approx(np.sum(np.square(left)), rel=1e-6)
    assert g == pytest.approx(np.sum(np.array(left) * r), rel=1e-5)
