"""The evidence of a pendulum's models against importance sampling with the simulator itself, and what it then names."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from bayessim_mjx.diagnosis import setup as preparing
from bayessim_mjx.diagnosis.evidence.gaussian import marginal, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import _truncated
from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.models import BASE
from bayessim_mjx.diagnosis.selection.successive_halving import begin
from tests.diagnosis import pendulums

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole searches
FRICTION = 0.06
DRY = frozenset(["coulomb_friction@hinge"])


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """(search, posterior) of logs with dry friction, other masses and noise."""
    robot = pendulums.nominal(tmp_path_factory.mktemp("model")).stated(["5%"], [])
    logs = pendulums.recorded(friction=FRICTION, scale=(1.05, 0.97, 1.03), count=6)
    setup = preparing.prepare(robot, logs, Request(["coulomb_friction", "viscous_friction"]))
    pool = begin(setup.fitter, setup.candidates, setup.settings)
    search = Search(pool, lambda *_: None)
    return search, search.run()


def test_what_is_missing_is_named_and_what_is_not_is_not(found):
    search, weighed = found
    assert weighed.answer == DRY
    assert weighed.weight[DRY] > 0.99
    model = search.state.models[DRY]
    assert model.fit.values[-2] == pytest.approx(FRICTION, rel=0.05)  # before its relaxation


def test_the_evidence_is_that_of_the_simulator(found):
    """Each within 5 nats, and the difference of two sets, some 500, within 3: the model is not quite linear."""
    off = [_sampled(found, key) for key in (DRY, BASE)]
    assert np.abs(off) == pytest.approx(0.0, abs=5.0)
    assert off[0] - off[1] == pytest.approx(0.0, abs=3.0)


def _sampled(found, key):
    """Evidence less an unbiased estimate of it: draws around the fit, each simulated; all else is integrated out."""
    search, _ = found
    weighing, scored = search.weighing, search.weighing.scored[key]
    fit, learnt, fitter = scored.fit, scored.learnt, search.state.fitter
    fixed = scored.model.fit
    precision = fit.belief()
    neutral = np.array([c.neutral for c in fit.coordinates]) - fit.values
    own = len(fixed.values)
    precision, neutral = precision[:own], neutral[:own]
    covariance = np.linalg.inv(learnt.Q[1:, 1:] + np.diag(fit.belief()))[:own, :own]
    rng, draws = np.random.default_rng(0), 400

    def log_density(p):
        theta = fitter.vector(fixed.coordinates, fixed.values + p)
        r = fitter.whiten(fitter.simulator.run(theta[None], fixed.offsets[None]))[0]
        sizes = fit.spread, weighing.scale, weighing.channels
        there = marginal(windows_of(r, fit.A[:, :, own:], fit.B, weighing.D, fit.offsets, *sizes), learnt.hyper)
        Q = there.Q.sum(0)  # of the residual and what simulators differ by, whose priors are standard normal
        whole = Q[1:, 1:] + np.eye(len(Q) - 1)
        cost = Q[0, 0] - Q[1:, 0] @ np.linalg.solve(whole, Q[1:, 0]) + np.linalg.slogdet(whole)[1]
        prior = 0.5 * np.sum(np.log(precision)) - 0.5 * np.sum(precision * (p - neutral) ** 2)
        return -0.5 * float(cost + there.logdet.sum()) + prior - 0.5 * own * np.log(2 * np.pi)

    # a fit with friction may rest in a basin beside: the second draws are about what the first ones found
    centre, width = learnt.step[:own], 2.0 * covariance
    for _ in range(2):
        proposal = multivariate_normal(centre, width)
        each = np.atleast_2d(proposal.rvs(draws, random_state=rng))
        logs = np.array([log_density(p) for p in each]) - proposal.logpdf(each)
        weights = np.exp(logs - logsumexp(logs))
        centre, width = weights @ each, covariance + np.cov(each.T, aweights=weights, ddof=0)
    sampled = logsumexp(logs) - np.log(draws) + learnt.penalty
    # both without the constant (2 pi) of the residuals; accuracies are stated, no number is at a bound
    assert 1 / np.sum(weights**2) > 50  # draws that count
    return scored.found.nats + sum(map(_truncated, fit.coordinates)) - sampled
