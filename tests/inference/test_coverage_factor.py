"""How deep truths lie in posteriors that are exact, too wide and too narrow by known factors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtri

from bayessim_mjx.distributions import charts
from bayessim_mjx.inference import temperature

N, D = 400, 2
MASK = jnp.ones(N)
EVERY = jnp.ones(D, bool)


def posteriors(factor, spread=0.05):
    """At `factor` 1 the sd is `spread`; two equal parts, so that the mixture is the Gaussian itself."""
    means = jnp.asarray(np.random.default_rng(0).uniform(0.4, 0.6, (N, 1, D)), jnp.float32)
    scales = jnp.broadcast_to(spread / factor * jnp.eye(D), (N, 2, D, D))
    return jnp.full((N, 2), np.log(0.5), jnp.float32), jnp.tile(means, (1, 2, 1)), scales


@jax.jit
def found_factor(z, mask):
    return temperature.coverage_factor(jax.random.PRNGKey(0), posteriors, z, mask, EVERY, "plain")


def truths(spread):
    noise = np.random.default_rng(1).normal(size=(N, D)) * spread
    return posteriors(1.0)[1][:, 0] + jnp.asarray(noise, jnp.float32)


@pytest.mark.slow
@pytest.mark.ci
def test_levels_of_exact_posteriors_are_uniform():
    found = np.asarray(
        temperature.coverage_levels(jax.random.PRNGKey(0), posteriors(1.0), truths(0.05), EVERY, "plain")
    )
    # Kolmogorov-Smirnov: 1.63 / sqrt(n) is exceeded by chance in 1 %
    assert np.max(np.abs(np.sort(found) - (np.arange(N) + 0.5) / N)) < 1.63 / N**0.5


@pytest.mark.slow
def test_the_level_of_a_gaussian_is_the_chi_square_probability():
    found = np.asarray(
        temperature.coverage_levels(jax.random.PRNGKey(0), posteriors(1.0), truths(0.05), EVERY, "plain")
    )
    distance = np.sum(np.asarray(truths(0.05) - posteriors(1.0)[1][:, 0]) ** 2, axis=1) / 0.05**2
    expected = 1 - np.exp(-distance / 2)  # chi-square with two degrees of freedom
    assert np.mean(np.abs(found - expected)) < 0.05  # 64 draws: .04 on average


def test_a_region_of_half_the_mass_holds_half_the_truths():
    """Truths at 10 000 even quantiles; ranks (k + 1/2) / 65 of 64 draws would put 33/65 = .508 into it."""
    n = 10_000
    z = 0.5 + 0.05 * jnp.asarray(ndtri((np.arange(n) + 0.5) / n), jnp.float32)
    mixtures = jnp.zeros((n, 1)), jnp.full((n, 1, 1), 0.5), jnp.full((n, 1, 1, 1), 0.05)
    found = np.asarray(
        jax.jit(lambda k: temperature.coverage_levels(k, mixtures, z[:, None], EVERY[:1], "plain"))(
            jax.random.PRNGKey(3)
        )
    )
    for region in (0.2, 0.5, 0.8):  # standard error below .002, the truths being even
        assert np.mean(found <= region) == pytest.approx(region, abs=0.005)


def test_draws_outside_the_box_are_not_the_posteriors():
    # N(0.5, 0.7^2) cut off at the box: among all draws, a quarter of which are inside, truths would be .23 deep
    rng = np.random.default_rng(2)
    z = rng.normal(0.5, 0.7, (20 * N, D))
    z = z[np.all((z > 0) & (z < 1), axis=1)][:N]
    scales = jnp.broadcast_to(0.7 * jnp.eye(D), (N, 1, D, D))
    mixtures = jnp.zeros((N, 1)), jnp.full((N, 1, D), 0.5), scales
    found = temperature.coverage_levels(jax.random.PRNGKey(0), mixtures, jnp.asarray(z, jnp.float32), EVERY, "plain")
    assert abs(float(jnp.mean(found)) - 0.5) < 0.05  # 3 / sqrt(12 N) = .043, and draws


@pytest.mark.parametrize("wide", [0.8, 1.0, 1.25])
def test_the_factor_undoes_what_is_too_wide_or_too_narrow(wide):
    z = truths(0.05 / wide)  # posteriors `wide` times as wide as they should be
    assert float(found_factor(z, MASK)) == pytest.approx(wide, rel=0.1)


def test_a_few_rows_are_hardly_believed():
    def of(first):
        few = jnp.where(jnp.arange(N) // 10 == first, 1.0, 0.0)
        return float(found_factor(truths(0.05), few))

    # ten truths alone would have the factor off by 20 %
    assert np.sqrt(np.mean(np.log([of(first) for first in range(8)]) ** 2)) < 0.1
    assert of(N) == 1.0  # nobody


def test_parameters_at_the_prior_do_not_hide_what_is_too_wide():
    """Two parameters beside eight that are at the prior, as Gaussians hardly any draw of which is in the box."""
    wide, others = 1.25, 8
    keep, more = (
        jnp.arange(D + others) < D,
        jnp.asarray(np.random.default_rng(4).uniform(size=(N, others)), jnp.float32),
    )

    def beside(factor):
        logits, means, scales = posteriors(factor)
        scales = jnp.pad(scales, ((0, 0), (0, 0), (0, others), (0, others)))
        flat = jnp.diag(jnp.where(keep, 0.0, charts.NEUTRAL["plain"][1]))
        return logits, jnp.pad(means, ((0, 0), (0, 0), (0, others)), constant_values=0.5), scales + flat

    z = jnp.concatenate([truths(0.05 / wide), more], axis=1)
    found = temperature.coverage_factor(jax.random.PRNGKey(0), beside, z, MASK, keep, "plain")
    assert float(found) == pytest.approx(wide, rel=0.1)
