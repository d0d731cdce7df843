"""The accuracy of a data sheet, inferred: against quadrature, and by coverage where the truth is drawn."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.diagnosis.data_sheet import ACCURACY, SURE
from bayessim_mjx.diagnosis.evidence import parameters
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit

PRIOR = stats.t(SURE, scale=ACCURACY)


def fitted(values, kinds, stated=()):
    """A fit at `values`; parameters behind them are stated to 5 %."""
    every = [Coordinate(str(i), (i,), 1.0, 0.3, 2.0, ACCURACY**-2, stated=True, kind=k) for i, k in enumerate(kinds)]
    every += [Coordinate(f"s{i}", (i,), 1.0, 0.3, 2.0, 400.0, stated=True) for i in range(len(stated))]
    return Fit(tuple(every), np.array([*values, *stated]), *(np.zeros(1),) * 5, 0.0)


def test_without_data_a_number_is_a_student_t_and_what_is_stated_stays():
    found = parameters.posterior(fitted([1.0], ["mass"], [1.0]), np.zeros((2, 2)))
    low, middle, high = found.quantiles()
    assert middle == pytest.approx([1.0, 1.0])
    assert high[0] - 1 == pytest.approx(PRIOR.ppf(0.95), rel=0.04) and high[1] - 1 == pytest.approx(
        1.645 * 0.05, rel=1e-3
    )
    assert low[0] == pytest.approx(2 - high[0])
    # the accuracy itself: ACCURACY / sqrt(gamma), by its own quantiles
    expected = ACCURACY / np.sqrt(stats.gamma(SURE / 2, scale=2 / SURE).ppf([0.95, 0.5]))
    assert found.accuracy("mass")[:2] == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize(("seen", "sd"), [(1.02, 0.03), (1.25, 0.05), (0.6, 0.2)])
def test_one_number_against_quadrature(seen, sd):
    """Measured as `seen` with a standard deviation of `sd`: posterior = t density times normal density."""
    grid = np.linspace(-1, 3, 80001)
    density = PRIOR.pdf(grid - 1) * stats.norm(seen, sd).pdf(grid)
    below = np.cumsum(density) / density.sum()
    exact = [grid[np.searchsorted(below, p)] for p in (0.05, 0.5, 0.95)]
    mode = grid[np.argmax(PRIOR.logpdf(grid - 1) + stats.norm(seen, sd).logpdf(grid))]
    fit = fitted([mode], ["mass"])
    fit = SimpleNamespace(coordinates=fit.coordinates, values=fit.values, away=fit.away)
    fit.belief = lambda: np.array([(seen - mode) / sd**2 / (mode - 1)])  # at the mode: prior and data in balance
    found = parameters.posterior(fit, np.array([[sd**-2]])).quantiles()[:, 0]
    assert found == pytest.approx(exact, abs=0.06 * (exact[2] - exact[0]))


def linear(rng, kinds, informed):
    """(truth, fit, curvature) of numbers whose accuracy is drawn from 2 to 30 %; data on some of their combinations."""
    n = len(kinds)
    share = np.exp(rng.uniform(np.log(0.02), np.log(0.3)))
    truth = 1 + share * rng.normal(size=n)
    J = rng.normal(size=(informed, n)) / 0.02
    S, g = J.T @ J, J.T @ (J @ (truth - 1) + rng.normal(size=informed))
    values = np.ones(n)
    for _ in range(200):  # the mode under the prior of the search
        belief = fitted(values, kinds).belief()
        values = 1 + np.linalg.solve(S + np.diag(belief), g)
    return truth, fitted(values, kinds), S


@pytest.mark.parametrize("informed", [0, 2, 5])
def test_intervals_hold_the_truth_whatever_the_accuracy_was(informed):
    rng, kinds = np.random.default_rng(informed), ["mass"] * 3 + ["damping"] * 2
    held, fixed = [], []
    for _ in range(150):
        truth, fit, S = linear(rng, kinds, informed)
        sd = np.sqrt(np.diag(parameters.posterior(fit, S).together()))
        held.append(np.abs(fit.values - truth) <= 1.645 * sd)
        covariance = np.linalg.inv(S + np.eye(5) / 0.05**2)
        fixed.append(np.abs(covariance @ (S @ (fit.values - 1)) + 1 - truth) <= 1.645 * np.sqrt(np.diag(covariance)))
    assert 0.86 <= np.mean(held) <= 0.95
    assert np.mean(fixed) < 0.8  # what 5 % for certain would hold


def test_data_on_some_numbers_tell_of_the_accuracy_of_the_others_of_their_kind():
    S = np.diag([1e6, 1e6, 1e6, 0.0, 0.0])
    kinds = ["mass"] * 4 + ["damping"]
    sharp = parameters.posterior(fitted([1.01, 0.99, 1.01, 1.0, 1.0], kinds), S)
    loose = parameters.posterior(fitted([1.3, 0.7, 1.3, 1.0, 1.0], kinds), S)
    sds = [np.sqrt(np.diag(p.together())) for p in (sharp, loose)]
    assert sds[0][3] < 0.6 * sds[0][4] and sds[1][3] > 2 * sds[1][4]  # the fourth mass beside a damping
    assert loose.accuracy("mass")[0] > 0.14 > sharp.accuracy("mass")[1]


def test_the_grid_of_accuracies_is_fine_enough(monkeypatch):
    S = np.diag([1e4, 1e2, 0.0, 3e2, 0.0])
    fit = fitted([1.2, 0.95, 1.0, 1.1, 1.0], ["mass"] * 3 + ["damping"] * 2)
    coarse = parameters.posterior(fit, S).quantiles()
    monkeypatch.setattr(parameters, "LEVELS", np.geomspace(0.01, 1.0, 49))
    fine = parameters.posterior(fit, S).quantiles()
    assert np.abs(coarse - fine).max() < 0.02 * (fine[2] - fine[0]).max()
