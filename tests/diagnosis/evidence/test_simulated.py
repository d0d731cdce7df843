"""The evidence of a pendulum's models against importance sampling with the simulator itself, and what it then names."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from bayessim_mjx.diagnosis import setup as preparing
from bayessim_mjx.diagnosis.evidence.gaussian import marginal, windows_of
from bayessim_mjx.diagnosis.evidence.parameters import _truncated
from bayessim_mjx.diagnosis.evidence.search import Search
from bayessim_mjx.diagnosis.selection import singles
from bayessim_mjx.diagnosis.selection.criteria import Criteria
from bayessim_mjx.diagnosis.selection.sets import BASE
from tests.diagnosis import pendulums

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole searches
FRICTION = 0.06
DRY = frozenset(["coulomb_friction@hinge"])


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """(search, posterior) of logs with dry friction, other masses and noise."""
    robot = pendulums.nominal(tmp_path_factory.mktemp("model")).stated(["5%"], [])
    logs = pendulums.recorded(friction=FRICTION, scale=(1.05, 0.97, 1.03), count=6)
    setup = preparing.prepare(robot, logs, ["coulomb_friction", "viscous_friction"])
    pool = singles.begin(setup.fitter, setup.candidates, setup.settings, Criteria())
    search = Search(pool, lambda *_: None)
    return search, search.run()


def test_what_is_missing_is_named_and_what_is_not_is_not(found):
    search, weighed = found
    assert weighed.answer == DRY
    assert weighed.weight[DRY] > 0.99
    model = search.pool.models[DRY]
    assert model.fit.values[-1] == pytest.approx(FRICTION, rel=0.05)


@pytest.mark.parametrize(("key", "within"), [(DRY, 0.6), (BASE, 4.0)], ids=["friction", "known parameters"])
def test_the_evidence_is_that_of_the_simulator(found, key, within):
    """Unbiased estimate: draws around the fit, each simulated, force and start state integrated out exactly.

    A set that lacks an effect leaves a large force, beside which the model is less linear: hundreds of nats behind, it
    is off by a few.
    """
    search, _ = found
    weighing, scored = search.weighing, search.weighing.scored[key]
    fit, learnt, fitter = scored.fit, scored.learnt, search.pool.fitter
    fixed = scored.model.fit
    precision = fit.belief()
    neutral = np.array([c.neutral for c in fit.coordinates]) - fit.values
    H = learnt.Q[1:, 1:] + np.diag(precision)
    rng, draws = np.random.default_rng(0), 400
    proposal = multivariate_normal(learnt.step, 1.2 * np.linalg.inv(H))
    steps = np.atleast_2d(proposal.rvs(draws, random_state=rng))
    logs = []
    for p in steps:
        theta = fitter.vector(fixed.coordinates, fixed.values + p[:-1])
        r = fitter.whiten(fitter.simulator.run(theta[None], fixed.offsets[None]))[0] - fit.A[:, :, -1] * p[-1]
        none = np.zeros((*r.shape, 0))
        own = windows_of(r, none, fit.B, weighing.D, fit.offsets, fitter.spread, weighing.scale, weighing.channels)
        there = marginal(own, learnt.hyper)
        likelihood = -0.5 * float(there.Q.sum() + there.logdet.sum())
        prior = 0.5 * np.sum(np.log(precision)) - 0.5 * np.sum(precision * (p - neutral) ** 2)
        logs.append(likelihood + prior - 0.5 * len(p) * np.log(2 * np.pi) - proposal.logpdf(p))
    sampled = logsumexp(logs) - np.log(draws) + learnt.penalty
    # both without the constant (2 pi) of the residuals; accuracies are stated, no number is at a bound
    weights = np.exp(np.array(logs) - logsumexp(logs))
    assert 1 / np.sum(weights**2) > 40  # draws that count
    assert scored.found.nats + _truncated(fit.coordinates) == pytest.approx(sampled, abs=within)
