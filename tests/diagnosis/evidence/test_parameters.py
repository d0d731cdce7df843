"""The integral over a model's parameters against quadrature: accuracies, bounds, and the price of what does nothing."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import logsumexp

from bayessim_mjx.diagnosis.data_sheet import ACCURACY, SURE
from bayessim_mjx.diagnosis.evidence import parameters
from bayessim_mjx.diagnosis.evidence.gaussian import Hyper, Learnt, learn, marginal
from bayessim_mjx.diagnosis.evidence.parameters import belief_of, integrated
from bayessim_mjx.diagnosis.fitting.candidates import Coordinate
from bayessim_mjx.diagnosis.fitting.fit import Fit
from bayessim_mjx.diagnosis.selection.numbers import PRIORS
from tests.diagnosis.evidence.linear import draw

HYPER = Hyper(np.array([0.02]), 4.0, np.array([1.0, 1.2]))


def fitted(coordinates, values):
    return Fit(tuple(coordinates), np.asarray(values, float), *(np.zeros(1),) * 5, 0.0)


def evidence(case, fit, columns=slice(None)):
    there = marginal(case.windows(columns), HYPER)
    learnt = Learnt(HYPER, belief_of(fit).best(there.Q.sum(0)), there, 0.0)
    return integrated(fit, learnt), there


def likelihood(there, p):
    """-2 log of it, relative to what all models have in common."""
    Q = there.Q.sum(0)
    p = np.atleast_1d(p)
    return -0.5 * (Q[0, 0] - 2 * Q[1:, 0] @ p + p @ Q[1:, 1:] @ p) - 0.5 * there.logdet.sum()


def test_a_gaussian_prior_in_closed_form():
    """Two parameters N(0, 1): the residuals' joint density, written out."""
    case = draw(0, p=[0.3, -0.2])
    fit = fitted([Coordinate(str(i), (i,), 0.0, -50.0, 50.0, 1.0) for i in range(2)], [0.0, 0.0])
    found, there = evidence(case, fit)
    Q = there.Q.sum(0)
    H = Q[1:, 1:] + np.eye(2)
    exact = -0.5 * (Q[0, 0] - Q[1:, 0] @ np.linalg.solve(H, Q[1:, 0]) + np.linalg.slogdet(H)[1] + there.logdet.sum())
    assert found.nats == pytest.approx(exact, rel=1e-9)
    assert found.posterior.middle == pytest.approx(np.linalg.solve(H, Q[1:, 0]), rel=1e-6)


def test_about_another_fit_the_evidence_is_the_same():
    """Residuals about other values are the same data, where the model is linear."""
    case = draw(1, p=[1.3, 0.8])
    ends = [Coordinate(str(i), (i,), 1.0, -50.0, 50.0, 4.0) for i in range(2)]
    one, _ = evidence(case, fitted(ends, [0.0, 0.0]))
    case.r = case.r - case.A @ np.array([1.1, 0.7])
    two, _ = evidence(case, fitted(ends, [1.1, 0.7]))
    assert one.nats == pytest.approx(two.nats, rel=1e-9)


@pytest.mark.parametrize("truth", [0.02, 0.25])
def test_the_accuracy_of_a_data_sheet_is_integrated_out(truth):
    """One number of a kind: its prior is a Student t."""
    case = draw(2, k=1, p=[truth])
    known = Coordinate("mass", (0,), 1.0, -20.0, 20.0, ACCURACY**-2, stated=True, kind="mass")
    found, there = evidence(case, fitted([known], [1.0]))
    prior = stats.t(SURE, scale=ACCURACY)
    top = max(likelihood(there, p) for p in np.linspace(-1, 1, 401))
    whole = integrate.quad(
        lambda p: prior.pdf(p) * np.exp(likelihood(there, p) - top), -2, 2, limit=400, points=[0, truth]
    )[0]
    assert found.nats == pytest.approx(top + np.log(whole), abs=0.1)


@pytest.mark.parametrize("truth", [-1.0, -0.1, 0.0, 0.6])
def test_a_bound_against_quadrature(truth):
    """A friction from 0 to 2 with a half-normal prior; where the data ask for less than 0, it ends at the bound."""
    case = draw(3, count=6, k=1, p=[truth])
    rubs = Coordinate("f", (0,), 0.0, 0.0, 2.0, 0.25)
    found, there = evidence(case, fitted([rubs], [0.0]))
    prior = stats.truncnorm(0.0, 1.0, scale=2.0)
    top = max(likelihood(there, p) for p in np.linspace(0, 2, 2001))
    whole = integrate.quad(lambda p: prior.pdf(p) * np.exp(likelihood(there, p) - top), 0, 2, limit=400)[0]
    assert found.nats == pytest.approx(top + np.log(whole), abs=0.7 if truth == 0.0 else 0.3)
    if truth < 0:
        square = integrate.quad(lambda p: p**2 * prior.pdf(p) * np.exp(likelihood(there, p) - top), 0, 2, limit=400)[0]
        assert found.beside == pytest.approx(np.sqrt(square / whole), rel=0.05)
    else:
        assert truth == 0.0 or found.beside == 0.0


@pytest.mark.parametrize("numbers", [1, 4])
def test_an_effect_that_does_nothing_costs_evidence(numbers):
    """Of pure noise and force, an effect of one or four useless numbers gains two nats hardly ever."""
    gains = []
    for seed in range(120):
        case = draw(5000 + seed, count=24, k=1 + numbers, p=np.zeros(1 + numbers))
        coordinates = [Coordinate(str(i), (i,), 0.0, -1.0, 1.0, 0.25) for i in range(1 + numbers)]
        with_it = fitted(coordinates, np.zeros(1 + numbers))
        without = fitted(coordinates[:1], [0.0])
        one = learn(case.windows(), belief_of(with_it))
        two = learn(case.windows(slice(0, 1)), belief_of(without), [one.hyper])
        own = [dict.fromkeys(range(1, 1 + numbers), False)]
        gains.append(integrated(with_it, one, own).nats - integrated(without, two).nats)
    assert np.mean(gains) < -0.5
    assert np.mean(np.array(gains) > 2.0) <= 0.017  # of 120: two at most


@pytest.mark.parametrize("truth", [0.1, 0.3])
def test_an_effect_of_any_size_against_quadrature(truth):
    """A friction from 0 to 20 with half-normal priors of 20, 2 and .2, each as likely."""
    case = draw(11, count=6, k=1, p=[truth])
    rubs = Coordinate("f", (0,), 0.0, 0.0, 20.0, 0.0025)
    fit = fitted([rubs], [0.0])
    there = marginal(case.windows(), HYPER)
    learnt = Learnt(HYPER, belief_of(fit).best(there.Q.sum(0)), there, 0.0)
    top = max(likelihood(there, p) for p in np.linspace(0, 2, 2001))

    def density(p):
        return np.mean([stats.truncnorm(0.0, 1.0 / size, scale=20.0 * size).pdf(p) for size in PRIORS.sizes])

    whole = integrate.quad(lambda p: density(p) * np.exp(likelihood(there, p) - top), 0, 2, limit=400)[0]
    found = integrated(fit, learnt, [{0: False}])
    assert found.nats == pytest.approx(top + np.log(whole), abs=0.1)
    assert found.nats > integrated(fit, learnt).nats + 1.0


@pytest.mark.parametrize("shapes", [(), (3,), (2, 3)])
@pytest.mark.parametrize("truth", [(0.4, 0.0, 0.0), (0.4, 0.3, -0.2)])
def test_a_number_of_an_effect_may_be_neutral(truth, shapes):
    """The mean of the evidences of all models with some of an effect's three numbers, in each size, found by itself.

    Shapes alone are no effect: of three amplitudes seven models, of two amplitudes and a shape six, of one four.
    """
    case = draw(7, k=4, p=[0.1, *truth])
    numbers = [Coordinate(str(i), (i,), 0.0, -50.0, 50.0, 1.0) for i in range(4)]
    whole = fitted(numbers, np.zeros(4))
    there = marginal(case.windows(), HYPER)
    learnt = Learnt(HYPER, belief_of(whole).best(there.Q.sum(0)), there, 0.0)
    each = []
    for n, size in itertools.product((1, 2, 3), PRIORS.sizes):
        sized = [c if i in (0, *shapes) else replace(c, precision=size**-2) for i, c in enumerate(numbers)]
        for some in itertools.combinations((1, 2, 3), n):
            if not {*some} <= {*shapes}:
                own = [0, *some]
                each.append(evidence(case, fitted([sized[i] for i in own], np.zeros(len(own))), own)[0].nats)
    found = integrated(whole, learnt, [{i: i in shapes for i in (1, 2, 3)}])
    assert len(each) == len(PRIORS.sizes) * {0: 7, 1: 6, 2: 4}[len(shapes)]
    assert found.nats == pytest.approx(logsumexp(each) - np.log(len(each)), abs=1e-3)
    gained = found.nats - integrated(whole, learnt).nats
    assert gained > 1.0 if truth[1] == 0 else gained < 0.0


@pytest.mark.parametrize("slope", [0.0, 0.3, 3.0, 100.0, 1e6])
def test_the_depth_of_a_layer_beside_a_bound(slope):
    """Against quadrature; far from the bound it is that of an exponential density, sqrt(2) / slope."""
    curvature, end = 4.0, min(10.0, 50.0 / max(slope, 1e-9))
    weight = [integrate.quad(lambda t, n=n: t**n * np.exp(-slope * t - 2.0 * t * t), 0, end)[0] for n in (0, 2)]
    assert parameters._depth(-slope, curvature) == pytest.approx(np.sqrt(weight[1] / weight[0]), rel=1e-6)
    assert slope < 1e3 or parameters._depth(slope, curvature) == pytest.approx(np.sqrt(2) / slope, rel=1e-6)
