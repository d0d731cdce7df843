"""A network and a formula against forces that are known: what they close, what the formula says, and what it takes."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.residual import black_boxes
from bayessim_mjx.diagnosis.residual.disturbance import estimate
from tests.diagnosis.missing_forces import fitted, record


def rubbing(t, data):
    """Coulomb friction and a bias."""
    return np.array([0.04 - 0.06 * np.tanh(data.qvel[0] / 0.005)])


def case(force):
    fitter, fit = fitted(record(force=force, logs=4, seconds=3.0), iterations=4)
    return fitter, fit, estimate(fitter, fit).linear


@pytest.fixture(scope="module")
def rubbed():
    return case(rubbing)


@pytest.mark.slow
def test_a_law_of_two_terms_is_written_down(rubbed):
    fitter, fit, missing = rubbed
    found = black_boxes.race(fitter, fit, None, missing, float(fitter.size))
    values = {term.what: term.force for term in found.terms}
    assert values["sign w"] == pytest.approx(-0.06, rel=0.1) and values["1"] == pytest.approx(0.04, rel=0.15)
    assert found.formula > 0.98 and 0.8 < found.network <= 1.0
    assert np.isnan(found.named) and found.folds == 4
    known = black_boxes.race(fitter, fit, fit, missing, float(fitter.size))
    assert known.named == 0.0  # the known parameters alone close nothing of what they leave


@pytest.mark.slow
@pytest.mark.ci
def test_nothing_is_explained_where_nothing_is_missing():
    fitter, fit, missing = case(None)
    problem, fold = black_boxes.Problem(fitter, fit, missing), fitter.simulator.windows.group
    noise = fit.r.size
    for cost in (black_boxes.network(problem, fold), black_boxes.formula(problem, fold)[0]):
        assert 0.8 * noise < cost.sum() < 1.3 * noise
