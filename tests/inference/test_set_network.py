"""Networks of sets: where their sets are drawn, what they pool, and what they make of a network that is off."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, set_network
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in "ab"])
NORMAL = ParameterSpace([Parameter(name, 0.0, -9.0, 9.0, prior="gaussian", mean=0.0, sd=1.0) for name in "ab"])
KEY = jax.random.PRNGKey(0)


def near(mean, sd, space=SPACE, chart="plain"):
    return Distribution.from_unit(space, np.zeros(1), np.array([mean]), np.diag(sd)[None], chart=chart)


def test_draws_fill_the_ellipsoid_around_a_posterior():
    y, mean, scale = set_network.draw_region(KEY, near([0.4, 0.6], [0.02, 0.01]), 4000)
    assert np.allclose(mean, [0.4, 0.6], atol=2e-3) and float(jnp.linalg.norm(y, axis=1).max()) <= 1.0
    # of a ball that is filled evenly in two dimensions the variance is 1 / 4 each
    assert np.allclose(np.cov(np.asarray(y).T), np.eye(2) / 4, atol=0.02)
    # as wide as the ellipse of all but 1.2e-7 of a Gaussian
    assert np.allclose(np.diagonal(scale), np.sqrt(-2 * np.log(2.0**-23)) * np.array([0.02, 0.01]), rtol=0.1)


def test_draws_stay_in_the_ranges_and_are_even_there():
    q = near([0.5, 0.05], [2.0, 0.02])  # nothing is known of the first; the second is at its end
    y, mean, scale = set_network.draw_region(KEY, q, 4000)
    u = np.asarray(mean + y @ scale.T)
    assert u.min() >= -1e-5 and u.max() <= 1 + 1e-5
    assert u[:, 0].mean() == pytest.approx(0.5, abs=0.03) and u[:, 0].var() == pytest.approx(1 / 12, rel=0.1)
    theta = np.asarray(set_network.theta_at(q, jnp.asarray(u)))
    assert np.allclose(theta, 2 * u - 1, atol=1e-5)


def test_draws_are_those_of_a_gaussian_prior():
    y, mean, scale = set_network.draw_region(KEY, near([0.5, 0.0], [0.9, 0.1], NORMAL, "probit"), 4000)
    z = np.asarray(mean + y @ scale.T)
    # the first has hardly been narrowed: all of its prior
    assert z[:, 0].mean() == pytest.approx(0.0, abs=0.08) and z[:, 0].std() == pytest.approx(1.0, abs=0.06)


def test_what_is_pooled_is_the_product_in_any_order():
    settings = InferenceSettings(hiddenLayers=(8,), ensemble=1, components=1)
    state = inference.init(KEY, settings, SPACE, 3)
    state.params["skip"] = 0.3 * jax.random.normal(KEY, state.params["skip"].shape)
    x = jax.random.normal(jax.random.PRNGKey(1), (3, 1, 3))
    features = set_network.pooled(state, list(x))
    assert np.allclose(features, set_network.pooled(state, list(x[::-1])), atol=1e-4)
    whole = inference.infer(state, x[:, 0], 1)
    assert np.allclose(features[0, :2], whole.means[0], atol=1e-4)
    assert np.allclose(features[0, 4:], x[:, 0].mean(0), atol=1e-5)
    precision = np.linalg.inv(np.asarray(whole.scales[0] @ whole.scales[0].T, np.float64))
    assert np.allclose(2 * features[0, 2:4], np.log(np.diagonal(np.linalg.cholesky(precision)) ** 2), atol=5e-3)


@pytest.mark.slow
def test_an_error_that_all_trajectories_share_is_learnt_away():
    """x = theta + N(0, .2^2); the network of single trajectories has learnt it with .1 added, and is sure of that."""
    settings = InferenceSettings(hiddenLayers=(16,), ensemble=2, components=1)
    thetas = Distribution.prior(SPACE).sample(KEY, 2000)

    def simulate(key, thetas):
        return thetas + 0.2 * jax.random.normal(key, thetas.shape)

    state = inference.init(KEY, settings, SPACE, 2)
    state, _ = inference.fit(KEY, state, thetas, simulate(KEY, thetas) + 0.1)
    at = jnp.asarray([0.2, -0.3])
    x = simulate(jax.random.PRNGKey(2), jnp.tile(at, (9, 1)))
    product = inference.infer(state, x, 1)
    assert float(jnp.abs(product.mean() - x.mean(0)).max()) > 0.08
    found = set_network.learn(jax.random.PRNGKey(3), state, product, simulate, 9, 2000)
    (own,) = found.posteriors([row[None] for row in x]).split()
    # the exact posterior is N(mean of x, .2^2 / 9) within the ranges
    assert np.allclose(own.mean(), x.mean(0), atol=0.02) and np.allclose(own.sd(), 0.2 / 3, rtol=0.15)
