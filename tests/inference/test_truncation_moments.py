"""Gaussians before the cut: their part inside has the moments they are made from; products at an end do not lean."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from bayessim_mjx.distributions import box
from bayessim_mjx.inference import InferenceSettings, calibration, condition, fit, init, truncation_moments
from bayessim_mjx.parameters import Parameter, ParameterSpace


def cut_at_ends(mean, sd):
    """scipy's Gaussian on [0, 1]."""
    return truncnorm((0 - mean) / sd, (1 - mean) / sd, mean, sd)


@pytest.mark.parametrize(
    ("mean", "sd"), [(0.5, 0.1), (0.5, 0.25), (0.1, 0.08), (0.02, 0.015), (0.9, 0.07), (0.7, 0.2), (0.3, 0.15)]
)
def test_the_part_inside_has_the_mean_and_sd_it_was_made_from(mean, sd):
    wide = truncation_moments.shapes(jnp.asarray([mean]), jnp.asarray([[sd]]))
    part = cut_at_ends(float(wide[0][0]), float(wide[1][0, 0]))
    assert part.mean() == pytest.approx(mean, abs=0.03 * sd) and part.std() == pytest.approx(sd, rel=0.03)


def test_what_is_flat_becomes_all_but_flat_and_what_lies_inside_stays():
    means, sds = jnp.asarray([0.5, 0.5]), jnp.diag(jnp.asarray([12**-0.5, 0.02]))
    wide = truncation_moments.shapes(means, sds)
    assert cut_at_ends(0.5, float(wide[1][0, 0])).std() == pytest.approx(12**-0.5, rel=0.03)
    np.testing.assert_allclose(wide[1][1], [0, 0.02], atol=1e-5)
    np.testing.assert_allclose(wide[0], [0.5, 0.5], atol=1e-5)


@pytest.mark.parametrize("correlation", [-0.5, 0.3, 0.8])
def test_two_parameters_that_go_together_keep_their_moments_roughly(correlation):
    """Moments of a Gaussian that one end cuts off, by a million draws, give its part inside again."""
    rng, sd = np.random.default_rng(0), np.array([0.15, 0.12])
    covariance = np.outer(sd, sd) * np.array([[1, correlation], [correlation, 1]])
    draws = rng.multivariate_normal([0.05, 0.5], covariance, 1_000_000)
    inside = draws[np.all((draws > 0) & (draws < 1), axis=1)]
    lower = np.linalg.cholesky(np.cov(inside.T))
    mean, scale = truncation_moments.shapes(jnp.asarray(inside.mean(0), jnp.float32), jnp.asarray(lower, jnp.float32))
    np.testing.assert_allclose(mean, [0.05, 0.5], atol=0.02)
    np.testing.assert_allclose(np.asarray(scale) @ np.asarray(scale).T, covariance, atol=0.25 * covariance.max())


def test_no_direction_becomes_wider_than_the_widest_and_all_stays_finite():
    rng = np.random.default_rng(1)
    lower = np.linalg.cholesky(np.full((6, 6), 0.95) + 0.05 * np.eye(6)) * rng.uniform(0.01, 0.4, (500, 6, 1))
    means = rng.uniform(-0.1, 1.1, (500, 6))
    mean, scale = truncation_moments.shapes(jnp.asarray(means, jnp.float32), jnp.asarray(lower, jnp.float32))
    assert np.isfinite(mean).all() and np.isfinite(scale).all()
    ratio = np.linalg.svd(np.linalg.solve(lower, np.asarray(scale, float)), compute_uv=False)
    assert ratio.max() < truncation_moments.WIDEST * 1.01 and ratio.min() > 0.99


def test_each_gaussian_keeps_its_share_of_what_is_inside():
    logits = jnp.log(jnp.asarray([[0.3, 0.5, 0.2]]))
    means = jnp.asarray([[[0.1, 0.5], [0.6, 0.6], [-3.0, 0.5]]])  # the last is all but outside, and stays as it is
    scales = jnp.tile(0.1 * jnp.eye(2), (1, 3, 1, 1))
    found = truncation_moments.weighed(logits, means, scales)
    before = jax.nn.log_softmax(logits)[0] + box.log_masses(means[0], scales[0])
    after = found[0][0] + box.log_masses(found[1][0], found[2][0])
    np.testing.assert_allclose(after, before, atol=0.02)
    np.testing.assert_array_equal(found[1][0, 2], means[0, 2])
    assert not np.allclose(found[1][0, 0], means[0, 0])


def test_a_product_of_many_at_an_end_is_the_exact_posterior():
    """theta ~ U[0, 1] at .02, sixteen measurements with noise of .3: Gaussians of the exact moments lean inwards."""
    rng, truth, sd, n = np.random.default_rng(2), 0.02, 0.3, 16
    gains = {"before the cut": [], "as they are": [], "exact": []}
    for _ in range(40):
        x = truth + sd * rng.normal(size=n)
        own = [cut_at_ends(value, sd) for value in x]
        moments = np.array([(q.mean(), q.std()) for q in own])
        wide = truncation_moments.shapes(
            jnp.asarray(moments[:, :1], jnp.float32), jnp.asarray(moments[:, 1:, None], jnp.float32)
        )
        before = np.stack([np.asarray(wide[0])[:, 0], np.asarray(wide[1])[:, 0, 0]], axis=1).astype(float)
        for name, (m, s) in {
            "before the cut": before.T,
            "as they are": moments.T,
            "exact": (x, np.full(n, sd)),
        }.items():
            weight = 1 / s**2
            mean, width = np.sum(weight * m) / weight.sum(), weight.sum() ** -0.5
            inside = norm.cdf((1 - mean) / width) - norm.cdf((0 - mean) / width)
            gains[name].append(norm.logpdf(truth, mean, width) - np.log(inside))
    exact, ours, plain = (np.mean(gains[k]) for k in ("exact", "before the cut", "as they are"))
    assert exact > 2 and ours == pytest.approx(exact, abs=0.3) and plain < exact - 5


def test_matched_coordinates_are_calibrated_where_little_is_told():
    """Measurements with noise of .8 to .03 of the ranges: plain networks are too narrow where it is large."""
    sds = np.geomspace(0.03, 0.8, 4).astype(np.float32)
    space = ParameterSpace([Parameter(f"t{i}", 0.5, 0.0, 1.0) for i in range(4)])

    def pairs(seed, n):
        keys = jax.random.split(jax.random.PRNGKey(seed))
        thetas = jax.random.uniform(keys[0], (n, 4))
        return thetas, thetas + sds[None] * jax.random.normal(keys[1], (n, 4))

    spread, gain = {}, {}
    for coordinates in ("plain", "matched"):
        settings = InferenceSettings(coordinates=coordinates, ensemble=1, components=2, hiddenLayers=(16,))
        state, _ = fit(jax.random.PRNGKey(1), init(jax.random.PRNGKey(0), settings, space, 4), *pairs(2, 4000))
        thetas, x = pairs(3, 1000)
        report = calibration.check(jax.random.PRNGKey(4), condition(state, x), thetas)
        spread[coordinates], gain[coordinates] = report.spread, report.gain
    assert spread["plain"][2:].max() > 4 and spread["matched"].max() < 3
    assert gain["matched"] > gain["plain"] + 0.05
