"""Posteriors refined by the simulator's likelihood: truths covered, noise estimated, model error widens."""

from types import SimpleNamespace

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.likelihood_refinement import _spread, refine
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record

pytestmark = pytest.mark.slow  # CI runs two rounds of the loop with it, test_replays_in_the_loop.py

SLIDER = """<mujoco><option timestep=".02" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="1"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><motor name="push" joint="x" gear="10"/></actuator></mujoco>"""
SPACE = ParameterSpace(
    [
        Parameter("mass", 1.0, 0.5, 2.0, operation="scaling", attribute="mass", target="cart", kind="body"),
        Parameter("damping", 1.0, 0.2, 3.0, operation="scaling", attribute="damping", target="x", kind="joint"),
    ]
)
PHYSICS = Physics(mujoco.MjModel.from_xml_string(SLIDER), 0.02, SPACE)
COUNT, STEPS, SD = 4, 50, 0.02


def recorded(seed, theta, gust=0.0):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1, 1, (2, COUNT, 1))
    command = np.repeat(rng.uniform(-1, 1, (COUNT, STEPS // 5, 1)), 5, axis=1)
    acted = command + gust * np.repeat(rng.normal(size=(COUNT, STEPS // 10, 1)), 10, axis=1)
    motion = replay(PHYSICS, *start, acted, np.tile(theta, (COUNT, 1)))
    rows = [np.asarray(motion[k]) + SD * rng.normal(size=motion[k].shape) for k in ("qpos", "qvel")]
    return Record(*(jnp.asarray(x, jnp.float32) for x in (*rows, command)))


def away(results, thetas):
    """Errors of the means in standard deviations, [cases, 2]."""
    rows = zip(thetas, results, strict=True)
    return np.array([(np.asarray(r.posterior.mean()) - t) / np.asarray(r.posterior.sd()) for t, r in rows])


def refined(seed, theta, gust=0.0):
    likelihood = Likelihood(PHYSICS, recorded(seed, theta, gust), np.ones((COUNT, STEPS)), np.full(2, SD))
    return refine(Distribution.prior(SPACE), likelihood, seed=seed, draws=256)


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(5)
    thetas = np.asarray([[rng.uniform(0.7, 1.7), rng.uniform(0.5, 2.5)] for _ in range(8)])
    return thetas, [refined(i, t) for i, t in enumerate(thetas)]


def test_truths_lie_where_the_posteriors_say(found):
    thetas, results = found
    assert not any(r.refined.reason for r in results)
    z = np.array(
        [
            (np.asarray(r.posterior.mean()) - t) / np.asarray(r.posterior.sd())
            for t, r in zip(thetas, results, strict=True)
        ]
    )
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6  # of 16 numbers the rms is 1 +- .18
    gains = [float(r.posterior.log_gain(jnp.asarray(t))) for t, r in zip(thetas, results, strict=True)]
    assert np.mean(gains) > 5.5


def test_noise_is_what_was_added(found):
    for r in found[1]:
        np.testing.assert_allclose(r.noise.sensor, SD, rtol=0.35)


def test_gusts_that_the_simulator_lacks_widen_it(found):
    thetas, results = found
    gusty = [refined(50 + i, t, gust=0.3) for i, t in enumerate(thetas)]
    z = np.array(
        [
            (np.asarray(r.posterior.mean()) - t) / np.asarray(r.posterior.sd())
            for t, r in zip(thetas, gusty, strict=True)
        ]
    )
    assert np.sqrt(np.mean(z**2)) < 1.8
    assert np.mean([np.asarray(r.posterior.sd()) for r in gusty]) > 2 * np.mean(
        [np.asarray(r.posterior.sd()) for r in results]
    )


def test_a_likelihood_that_is_a_lottery_keeps_the_proposal():
    record = recorded(0, np.ones(2))
    nowhere = record.replace(qvel=record.qvel.at[:, 3].set(jnp.nan))
    prior = Distribution.prior(SPACE)
    found = refine(prior, Likelihood(PHYSICS, nowhere, np.ones((COUNT, STEPS)), np.full(2, SD)), draws=256)
    assert found.posterior is prior and found.refined.reason


@pytest.mark.parametrize("impossible", [np.inf, np.nan])
def test_simulations_that_diverge_count_for_nothing(impossible):
    rng = np.random.default_rng(0)
    z, squares = rng.normal(size=(50, 2)), rng.chisquare(6, (50, 3, 4))
    likelihood = SimpleNamespace(count=72.0, least=0.0, groups=np.arange(3))
    without, _ = _spread(z, squares, likelihood)
    diverged = np.concatenate([squares, np.full((1, 3, 4), impossible)])
    np.testing.assert_allclose(_spread(np.concatenate([z, np.ones((1, 2))]), diverged, likelihood)[0], without)


def test_prediction_errors_that_are_small_by_chance_make_nothing_sharper():
    """The slope in the sum of squares is -1/2 over the variance of the noise, which sensors' own is the least of."""
    for count in (120.0, 480.0, 20_000.0):
        for total, variance in ((0.7 * count, 1.0), (0.05 * count, 1.0), (3 * count, 3.0)):
            squares = np.array([total - 1, total + 1])[:, None, None]
            value = Likelihood.log_likelihood(SimpleNamespace(count=count, least=1.0), squares)
            assert (value[1] - value[0]) / 2 == pytest.approx(-0.5 / variance, rel=0.05)
