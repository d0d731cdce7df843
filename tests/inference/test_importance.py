"""Refinement by importance sampling and moves against posteriors that are known, from proposals that are wrong."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import genpareto, norm

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.final_importance_sampling import (
    UNRELIABLE,
    final_importance_sampling,
    generalised_pareto,
    smoothed,
)
from bayessim_mjx.inference.importance import Problem, Refined, refine, sharpened
from bayessim_mjx.inference.mixture_fit import Mixture
from bayessim_mjx.inference.smc import ess_of
from bayessim_mjx.loop.likelihood_refinement import Refinement
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in "abc"])
DESIGN = np.random.default_rng(0).normal(size=(40, 3))
SIGMA = 0.3
TRUTH = np.array([0.3, -0.5, 0.6])
DATA = DESIGN @ TRUTH + SIGMA * np.random.default_rng(1).normal(size=40)
COVARIANCE = SIGMA**2 * np.linalg.inv(DESIGN.T @ DESIGN)  # of the posterior: its box is far away
MEAN = COVARIANCE @ DESIGN.T @ DATA / SIGMA**2


def gaussian(theta):
    return -0.5 * ((theta @ DESIGN.T - DATA) ** 2).sum(1) / SIGMA**2


SD = np.sqrt(np.diag(COVARIANCE))
PROPOSALS = {
    "the prior": Distribution.prior(SPACE),
    "too narrow and beside it": Distribution.gaussian(SPACE, MEAN + 3 * SD, SD / 2),
    "too wide": Distribution.gaussian(SPACE, MEAN - 2 * SD, 6 * SD),
}


@pytest.mark.parametrize("name", PROPOSALS)
@pytest.mark.slow
def test_a_linear_gaussian_posterior_is_found_from_wrong_proposals(name):
    found = refine(Problem(PROPOSALS[name], gaussian), seed=3)
    assert found.reason is None and found.effective >= 150
    drawn = np.asarray(SPACE.from_unit(found.population.islands.reshape(-1, 3)))
    np.testing.assert_allclose(drawn.mean(0), MEAN, atol=0.25 * SD.min())
    np.testing.assert_allclose(drawn.std(0), SD, rtol=0.1)
    np.testing.assert_allclose(found.posterior.mean(), MEAN, atol=0.3 * SD.min())
    np.testing.assert_allclose(found.posterior.sd(), SD, rtol=0.2)
    # log of the integral of likelihood x prior density (1/8 in the box)
    evidence = gaussian(MEAN[None])[0] + 0.5 * np.linalg.slogdet(2 * np.pi * COVARIANCE)[1] + np.log(1 / 8)
    assert found.evidence == pytest.approx(evidence, abs=0.4)


@pytest.mark.slow
def test_two_modes_are_both_kept():
    def mirrored(theta):
        return norm.logpdf(np.abs(theta[:, 0]), 0.5, 0.02) + norm.logpdf(theta[:, 1:], 0.1, 0.05).sum(1)

    found = refine(Problem(Distribution.prior(SPACE), mirrored, draws=2048))
    assert found.reason is None
    left = found.posterior.sample(jnp.asarray([0, 1], jnp.uint32), 2000)[:, 0] < 0
    assert float(left.mean()) == pytest.approx(0.5, abs=0.08)
    truth = np.array([[0.5, 0.1, 0.1], [-0.5, 0.1, 0.1]])
    exact = np.log(0.5) + norm.logpdf(0, 0, 0.02) + 2 * norm.logpdf(0, 0, 0.05)
    np.testing.assert_allclose(found.posterior.log_prob(jnp.asarray(truth)), exact, atol=0.35)


def test_a_posterior_at_the_end_of_a_range():
    like = lambda t: norm.logpdf(t[:, 0], 1.2, 0.2) + norm.logpdf(t[:, 1:], 0, 0.1).sum(1)  # noqa: E731
    found = refine(Problem(Distribution.prior(SPACE), like))
    z = np.linspace(-1, 1, 4001)
    weight = norm.pdf(z, 1.2, 0.2)
    assert found.reason is None
    assert float(found.posterior.mean()[0]) == pytest.approx(np.average(z, weights=weight), abs=0.03)


def test_what_cannot_be_sampled_keeps_the_proposal_and_says_why():
    prior = PROPOSALS["the prior"]
    rough = np.random.default_rng(0)
    lottery = refine(Problem(prior, lambda t: 400.0 * rough.normal(size=len(t)), rounds=3))
    assert lottery.posterior is prior and "can be followed to its power" in lottery.reason
    nowhere = refine(Problem(prior, lambda t: np.full(len(t), np.nan), rounds=3))
    assert nowhere.posterior is prior and nowhere.reason == "none of 3072 simulations has a finite likelihood"


def test_weights_are_smoothed_by_the_tail_that_they_have():
    rng = np.random.default_rng(0)
    for shape in (0.2, 0.5, 0.9):
        x = np.sort(genpareto.rvs(shape, size=4000, random_state=1))
        found, scale = generalised_pareto(x)
        assert found == pytest.approx(shape, abs=0.06) and scale == pytest.approx(1.0, rel=0.1)
    weights, tail = smoothed(rng.normal(size=4000))
    assert weights.sum() == pytest.approx(1.0) and tail < 0.5
    assert smoothed(6 * rng.normal(size=4000))[1] > 0.7
    assert ess_of(np.full(50, 1 / 50)) == pytest.approx(50)


def test_where_few_draws_are_possible_the_next_are_drawn_among_them():
    """Fewer than should count: the likelihood's power is 0, and 0 times minus infinity is no number."""

    def hardly(theta):
        return np.where(np.abs(theta).max(1) < 0.25, gaussian(0 * theta), -np.inf)

    with np.errstate(invalid="raise"):
        found = refine(Problem(Distribution.prior(SPACE), hardly, draws=512))
    assert np.isfinite(found.population.like).all() and found.reason is None
    np.testing.assert_allclose(found.posterior.mean(), 0, atol=0.05)


def several(d):
    return ParameterSpace([Parameter(f"p{i}", 1.0, 0.5, 2.0) for i in range(d)])


@pytest.mark.slow
def test_parameters_times_one_number_leave_a_valley_that_is_followed_to_its_ends():
    """Two ratios of three parameters are known to .5 %, as of mass, damping and motor from motion alone."""
    space, rng, levels = several(3), np.random.default_rng(0), []
    for seed in range(6):
        truth = rng.uniform(0.5, 2, 3)
        seen = truth[:2] / truth[1:] + 0.005 * rng.normal(size=2)
        like = lambda t, seen=seen: -0.5 * ((t[:, :2] / t[:, 1:] - seen) ** 2).sum(1) / 0.005**2  # noqa: E731
        found = refine(Problem(Distribution.prior(space), like, draws=512), seed)
        assert found.reason is None
        assert float(found.posterior.log_gain(jnp.asarray(truth))) > 6
        levels.append(float(found.posterior.credible_level(jnp.asarray(truth))))
    assert max(levels) < 0.99 and 1 <= np.sum(np.array(levels) < 0.5) <= 5


@pytest.mark.slow
@pytest.mark.ci
def test_seventeen_parameters_of_which_eleven_are_not_seen():
    space, rng = several(17), np.random.default_rng(1)
    design, truth = np.zeros((8, 17)), rng.uniform(0.7, 1.8, 17)
    design[:, :6] = rng.normal(size=(8, 6))
    seen = design @ truth + 0.1 * rng.normal(size=8)
    like = lambda t: -0.5 * ((t @ design.T - seen) ** 2).sum(1) / 0.1**2  # noqa: E731
    found = refine(Problem(Distribution.prior(space), like), seed=2)
    assert found.reason is None
    exact = 0.1 * np.sqrt(np.diag(np.linalg.inv(design[:, :6].T @ design[:, :6])))
    np.testing.assert_allclose(found.posterior.sd()[:6], exact, rtol=0.25)
    np.testing.assert_allclose(found.posterior.sd()[6:], 1.5 / 12**0.5, rtol=0.1)  # the prior's, to the range's ends
    np.testing.assert_allclose(found.posterior.mean()[6:], 1.25, atol=0.12)


def test_a_narrow_posterior_at_a_thousandth_of_its_range():
    centre, sd = np.array([-0.999, 0.5, 0.2]), np.array([1e-6, 1e-4, 1e-2])
    found = refine(Problem(Distribution.prior(SPACE), lambda t: norm.logpdf(t, centre, sd).sum(1), draws=512))
    assert found.reason is None
    drawn = found.population.islands.reshape(-1, 3) * 2 - 1
    np.testing.assert_allclose(drawn.std(0), sd, rtol=0.2)
    np.testing.assert_allclose(
        2 * np.sqrt(np.diag(found.posterior.scales[0] @ found.posterior.scales[0].T)), sd, rtol=0.2
    )


def valley(rng, seen, sd, count):
    """Exact draws of three parameters of which two ratios are known: theta = t (r s, s, 1), of volume t^2 s."""
    r = seen + sd * rng.normal(size=(20 * count, 2))
    shape = np.stack([r[:, 0] * r[:, 1], r[:, 1], np.ones(len(r))], axis=1)
    low, high = (0.5 / shape).max(1), (2 / shape).min(1)
    mass = np.maximum(high**3 - low**3, 0) * r[:, 1]
    chosen = rng.choice(len(r), count, p=mass / mass.sum())
    low, high = low[chosen] ** 3, high[chosen] ** 3
    return ((low + rng.random(count) * (high - low)) ** (1 / 3))[:, None] * shape[chosen]


@pytest.mark.slow
def test_independent_draws_bring_the_regions_nearer_to_what_they_say():
    space, rng, gained, held = several(3), np.random.default_rng(0), [], []
    for seed in range(4):
        truth = rng.uniform(0.6, 1.9, 3)
        seen = truth[:2] / truth[1:] + 0.005 * rng.normal(size=2)

        def like(t, seen=seen):
            return -0.5 * ((t[:, :2] / t[:, 1:] - seen) ** 2).sum(1) / 0.005**2

        prior = Distribution.prior(space)
        problem = Problem(prior, like, draws=512)
        found = refine(problem, seed)
        better = sharpened(problem, found, seed=seed)
        assert better.effective > 2000 > found.effective
        draws = jnp.asarray(valley(rng, seen, 0.005, 2000), jnp.float32)
        gained.append(float(jnp.mean(better.posterior.log_prob(draws) - found.posterior.log_prob(draws))))
        held.append([float(np.mean(better.posterior.credible_level(draws) < p)) for p in (0.5, 0.8, 0.95)])
    assert np.mean(gained) > 0.01
    np.testing.assert_allclose(np.mean(held, axis=0), [0.5, 0.8, 0.95], atol=0.03)


@pytest.mark.parametrize(("wide", "fits"), [(1.0, True), (6.0, False)])
def test_the_tail_of_the_weights_is_kept_and_warned_of(wide, fits):
    """Draws from Gaussians as wide as the posterior, and a sixth of it: then few draws have all the weight."""
    own = Mixture(np.ones(1), np.full((1, 2), 0.5), (0.02 * np.eye(2))[None] ** 2)
    rng = np.random.default_rng(0)
    found = final_importance_sampling(rng, own, lambda u: -0.5 * (((u - 0.5) / (0.02 * wide)) ** 2).sum(1), 256)
    assert (found.shape < UNRELIABLE) is fits
    refined = Refined(None, None, None, found.ess, 4096, np.zeros(2), None, found.shape)
    refinement = Refinement(refined, None, 1.0)
    assert (refinement.warning() is None) is fits and refinement.to_dict()["pareto_k"] == found.shape
    assert fits or f"k = {found.shape:.2g}" in refinement.warning()
    assert Refinement(dataclasses.replace(refined, shape=None), None, 1.0).warning() is None
