"""Gaussians fitted to draws of a posterior in the unit cube."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.distributions.box import within
from bayessim_mjx.inference.mixture_fit import em, in_cube, match_truncated_moments, supported
from bayessim_mjx.inference.mixture_fit import fitted as gaussians
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(f"p{i}", 0.5, 0.0, 1.0) for i in range(10)])


def drawn(rng, count, tied=False):
    """Eight parameters of which nothing is known and two that are told; tied: two of the eight are the same."""
    told = 0.3 + 0.05 * rng.normal(size=(count, 2))
    free = rng.uniform(size=(count, 8))
    if tied:
        free[:, 1] = np.clip(free[:, 0] + 0.02 * rng.normal(size=count), 0, 1)
    return np.concatenate([free, told], axis=1)


def fitted(draws, worth):
    q = match_truncated_moments(
        em(np.random.default_rng(0), draws, np.full(len(draws), 1 / len(draws)), 1), draws, worth
    )
    return Distribution.from_unit(SPACE, np.log(q.weights), q.means, np.linalg.cholesky(q.covariances))


def test_regions_hold_what_they_say_where_most_parameters_are_not_told():
    """By moments alone the 50 % region held a third of fresh draws: a little too narrow in eight directions."""
    rng, levels = np.random.default_rng(1), []
    for _ in range(6):
        q = fitted(drawn(rng, 256), 256)
        levels.append(np.asarray(q.credible_level(jnp.asarray(drawn(rng, 400), jnp.float32))))
    held = [np.mean(np.concatenate(levels) <= p) for p in (0.5, 0.8, 0.95)]
    np.testing.assert_allclose(held, (0.5, 0.8, 0.95), atol=0.05)


def test_what_is_tied_to_another_is_not_flat():
    """Each of two is uniform alone; what is told of one by the other is kept."""
    q = fitted(drawn(np.random.default_rng(2), 512, tied=True), 512)
    x = np.asarray(q.sample(jax.random.key(0), 2000))
    assert np.std(x[:, 0] - x[:, 1]) < 0.06 and np.std(x[:, 0]) > 0.25


def test_points_within_the_cube_have_the_truncated_gaussians_moments():
    """Against draws that are kept where they are inside."""
    rng = np.random.default_rng(3)
    mean, scale = np.array([0.9, 0.4, 0.1]), np.array([[0.5, 0, 0], [0.3, 0.2, 0], [-0.1, 0.1, 0.4]])
    x, weights = within(mean, scale)
    z = mean + rng.normal(size=(400_000, 3)) @ scale.T
    z = z[np.all((z >= 0) & (z <= 1), axis=1)]
    at = weights @ x
    np.testing.assert_allclose(at, z.mean(0), atol=4e-3)
    np.testing.assert_allclose((x - at).T @ ((x - at) * weights[:, None]), np.cov(z.T), atol=2e-3)


def test_no_gaussian_stands_on_a_few_draws_of_much_weight():
    """Four of 400 draws hold a tenth of the weight, in one place: two Gaussians would be a whole and a spike."""
    rng = np.random.default_rng(4)
    z = rng.normal(size=(400, 6))
    z[:4] = 4.0 + 1e-3 * rng.normal(size=(4, 6))
    weights = np.where(np.arange(400) < 4, 0.1 / 4, 0.9 / 396)
    assert em(rng, z, weights, 2).covariances[:, 0, 0].min() < 0.02
    assert len(supported(rng, z, weights, 2).weights) == 1


def test_where_most_parameters_are_not_told_a_curved_valley_has_the_gaussians_that_it_needs():
    """A parabola in two of ten parameters: in all ten, draws are too few for more than two Gaussians."""
    rng = np.random.default_rng(5)

    def valley(count):
        u = rng.uniform(size=(count, 10))
        u[:, 8] = 0.2 + 0.6 * u[:, 8]
        u[:, 9] = 0.2 + 1.5 * (u[:, 8] - 0.5) ** 2 + 0.01 * rng.normal(size=count)
        return u

    draws, fresh = valley(256), jnp.asarray(valley(1000), jnp.float32)
    equal = np.full(256, 1 / 256)
    q = in_cube(lambda own: gaussians(rng, draws[:, own], equal, 8), draws, 256)
    assert len(q.weights) > 2
    np.testing.assert_array_equal(q.means[:, :8], 0.5)
    found = Distribution.from_unit(SPACE, np.log(q.weights), q.means, np.linalg.cholesky(q.covariances))
    whole = fitted(draws, 256)
    assert float(np.mean(found.log_gain(fresh))) > float(np.mean(whole.log_gain(fresh))) + 0.5


def test_weighted_draws_are_fitted_as_they_are_and_not_by_a_draw_of_them():
    """Draws of one posterior, weighted to be those of another: cut off at the walls they have its moments."""
    rng = np.random.default_rng(6)
    u = rng.uniform(size=(4000, 3))
    weights = np.exp(-0.5 * (((u - [0.02, 0.5, 0.4]) / [0.2, 0.1, 5.0]) ** 2).sum(1))
    weights /= weights.sum()
    worth = 1 / np.sum(weights**2)
    q = in_cube(lambda own: gaussians(rng, u[:, own], weights, 1), u, worth, weights)
    np.testing.assert_array_equal(q.means[:, 2], 0.5)  # flat
    x, within_ = within(q.means[0], np.linalg.cholesky(q.covariances[0]))
    np.testing.assert_allclose((within_ @ x)[:2], (weights @ u)[:2], atol=2e-3)
    variances = weights @ (u - weights @ u) ** 2
    np.testing.assert_allclose((within_ @ (x - within_ @ x) ** 2)[:2], variances[:2], rtol=0.02)
