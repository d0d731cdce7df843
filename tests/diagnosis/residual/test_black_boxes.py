"""A network and a formula against forces that are known: what they close, what the formula says, and what it takes."""

import numpy as np
import pytest

from bayessim_mjx.diagnosis.residual import black_boxes
from bayessim_mjx.diagnosis.residual.disturbance import estimate
from bayessim_mjx.diagnosis.residual.motion_inputs import measured
from bayessim_mjx.diagnosis.residual.regression import Regression
from tests.diagnosis.missing_forces import fitted, record


def rubbing(t, data):
    """Coulomb friction and a bias."""
    return np.array([0.04 - 0.06 * np.tanh(data.qvel[0] / 0.005)])


def case(force):
    fitter, fit = fitted(record(force=force, logs=4, seconds=3.0), iterations=4)
    return fitter, fit, estimate(fitter, fit)


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
    problem = Regression(fitter, fit, missing, measured(fitter.simulator.windows, fitter.simulator.physics.mj_model))
    fold = fitter.simulator.windows.group
    noise = fit.r.size
    for cost in (black_boxes.network_costs(problem, fold), black_boxes.formula_costs(problem, fold)[0]):
        assert 0.8 * noise < cost.sum() < 1.3 * noise


@pytest.mark.slow
@pytest.mark.ci
def test_the_networks_gradient_is_that_of_its_cost(rubbed, monkeypatch):
    """By finite differences at a random point: the slope through the columns, parameters eliminated."""
    fitter, fit, missing = rubbed
    problem = Regression(fitter, fit, missing, measured(fitter.simulator.windows, fitter.simulator.physics.mj_model))
    rng, seen = np.random.default_rng(3), []

    def look(cost, start, **_):
        x, along = start + 0.1 * rng.normal(size=len(start)), rng.normal(size=len(start))
        sides = [cost(x + h * along)[0] for h in (-1e-5, 1e-5)]
        seen.append(((sides[1] - sides[0]) / 2e-5, cost(x)[1] @ along))
        return type("Found", (), {"x": x})

    monkeypatch.setattr(black_boxes, "minimize", look)
    black_boxes.network_costs(problem, fitter.simulator.windows.group % 2)
    for differences, gradient in seen:
        assert gradient == pytest.approx(differences, rel=1e-4)
