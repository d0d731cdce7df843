"""Parameters that the data say nothing about stay at the prior, however many trajectories multiply."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ndtr

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution, charts
from bayessim_mjx.inference import identify
from bayessim_mjx.inference.checks import flat_sentences
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("seen", 0.0, -1.0, 1.0), Parameter("unseen", 5.0, 0.0, 10.0)])


@pytest.fixture(scope="module")
def fitted():
    """x = seen + N(0, 0.2); unseen does not enter."""
    thetas = jax.vmap(SPACE.from_unit)(jax.random.uniform(jax.random.PRNGKey(0), (4000, 2)))
    x = thetas[:, :1] + 0.2 * jax.random.normal(jax.random.PRNGKey(1), (4000, 1))
    settings = inference.InferenceSettings(components=4, hiddenLayers=(32,))
    return inference.fit(jax.random.PRNGKey(2), inference.init(jax.random.PRNGKey(3), settings, SPACE, 1), thetas, x)


@pytest.mark.slow
def test_the_held_out_gain_tells_them_apart(fitted):
    state, info = fitted
    np.testing.assert_array_equal(np.asarray(state.identified), [True, False])
    # the expected gain is the mutual information h(x) - h(noise), x being uniform plus Gaussian
    x = np.linspace(-2.5, 2.5, 20001)
    density = (ndtr((x + 1) / 0.2) - ndtr((x - 1) / 0.2)) / 2
    entropy = -np.trapezoid(density * np.log(np.maximum(density, 1e-300)), x)
    information = entropy - 0.5 * np.log(2 * np.pi * np.e * 0.2**2)
    assert float(info.parameter_gain[0]) == pytest.approx(information, abs=0.08)
    assert float(info.parameter_gain[1]) < 0.005


@pytest.mark.slow
@pytest.mark.ci
def test_the_product_of_many_leaves_the_unseen_one_flat(fitted):
    state, _ = fitted
    x = 0.3 + 0.2 * jax.random.normal(jax.random.PRNGKey(4), (20, 1))
    product = inference.combine(inference.condition(state, x), 4)
    posterior = inference.restore_prior(product, state.identified)
    assert float(posterior.contraction()[1]) == pytest.approx(0.0, abs=0.01)
    assert float(posterior.mean()[1]) == pytest.approx(5.0, abs=0.05)
    assert float(posterior.sd()[0]) == pytest.approx(float(product.sd()[0]), rel=0.02)
    samples = np.asarray(posterior.sample(jax.random.PRNGKey(5), 4000))
    assert np.histogram(samples[:, 1], bins=5, range=(0, 10))[0] == pytest.approx([800] * 5, abs=120)


def test_marginal_gain_by_hand():
    """One Gaussian of sd 0.1 in the middle: 1 / (0.1 sqrt(2 pi)) = 3.989 at its mean; flat where sd is large."""
    scales = jnp.asarray([[[[0.1, 0.0], [0.0, 50.0]]]])
    gain = identify.marginal_gain(jnp.zeros((1, 1)), jnp.full((1, 1, 2), 0.5), scales, jnp.full((1, 2), 0.5))
    np.testing.assert_allclose(np.asarray(gain), [[np.log(3.98942), 0.0]], atol=1e-4)


def test_all_kept_changes_nothing():
    q = Distribution.gaussian(SPACE, [0.2, 4.0], [0.1, 1.0], components=2)
    kept = inference.restore_prior(q, jnp.ones(2, bool))
    theta = jnp.asarray([[0.2, 4.0], [0.0, 5.0], [0.9, 9.0]])
    np.testing.assert_allclose(np.asarray(kept.log_prob(theta)), np.asarray(q.log_prob(theta)), atol=1e-3)


def test_thin_components_survive():
    """Correlation 1 - 1e-9: the covariance is singular in float32, its factor is not."""
    thin = jnp.asarray([[[0.2, 0.0], [0.2, 1e-5]]])
    q = Distribution.from_unit(SPACE, jnp.zeros(1), jnp.full((1, 2), 0.5), thin)
    kept = identify.restore_prior(q, jnp.ones(2, bool))
    np.testing.assert_allclose(np.asarray(kept.scales), np.asarray(thin), rtol=1e-3, atol=1e-7)
    half = identify.restore_prior(q, jnp.asarray([False, True]))
    np.testing.assert_allclose(
        np.asarray(half.scales[0]), [[charts.NEUTRAL["plain"][1], 0.0], [0.0, 0.2]], rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("corr", [0.6, -0.6])
def test_what_a_cut_moves_stays_moved(corr):
    """One Gaussian whose other parameter lies beyond its range: the kept marginal by quadrature over both."""
    mean, sd = np.array([0.4, 1.6]), np.array([0.05, 0.7])
    cov = np.outer(sd, sd) * [[1, corr], [corr, 1]]
    q = Distribution.from_unit(SPACE, jnp.zeros(1), jnp.asarray(mean)[None], jnp.asarray(np.linalg.cholesky(cov))[None])
    kept = identify.restore_prior(q, jnp.asarray([True, False]))
    axis = (np.arange(400) + 0.5) / 400
    gap = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1) - mean
    density = np.exp(-0.5 * np.einsum("abi,ij,abj->ab", gap, np.linalg.inv(cov), gap)).sum(1)
    density /= density.sum()
    exact = density @ axis
    assert abs(exact - mean[0]) > 0.8 * sd[0]  # what the Gaussian's own marginal would have missed
    assert float(kept.means[0, 0]) == pytest.approx(exact, abs=0.01 * sd[0])
    assert float(kept.scales[0, 0, 0]) == pytest.approx(np.sqrt(density @ (axis - exact) ** 2), rel=0.01)
    assert abs(float(kept.contraction()[1])) < 0.003


def test_flat_parameters_are_named():
    texts = flat_sentences(
        ("arm mass", "slider mass", "friction"), np.array([0.9, 0.01, 0.6]), np.array([0.8, 0.0, 0.01])
    )
    assert texts[0] == "slider mass: not identified by these trajectories"
    assert texts[1].startswith("friction: not identified by the real trajectories") and len(texts) == 2


@pytest.mark.parametrize("chart", ["plain", "probit", "logit"])
def test_the_prior_is_restored_in_every_chart_and_a_product_of_many_keeps_it(chart):
    """Also where components are correlated: the kept marginal stays, twelve factors know nothing of the other."""
    centre, sd = charts.NEUTRAL[chart] if chart != "plain" else (0.5, 0.2)
    scales = 0.5 * sd * jnp.asarray([[[1.0, 0.0], [0.8, 0.3]], [[0.7, 0.0], [-0.5, 0.4]]])
    means = centre + sd * jnp.asarray([[0.1, 0.2], [-0.2, 0.4]])
    q = Distribution.from_unit(SPACE, jnp.asarray([0.3, 0.0]), means, scales, 0.02, chart)
    kept = inference.restore_prior(q, jnp.asarray([True, False]))
    assert kept.chart == chart and float(kept.prior_weight) == pytest.approx(0.02)
    theta = jnp.asarray([[-0.5], [0.0], [0.4]])
    seen = [d.marginal(["seen"]).log_prob(theta) for d in (q, kept)]
    np.testing.assert_allclose(*map(np.asarray, seen), atol=0.02)
    assert abs(float(kept.contraction()[1])) < (0.06 if chart == "logit" else 0.003)
    many = inference.combine([kept] * 12, 2)
    assert abs(float(many.contraction()[1])) < 0.06 < float(many.contraction()[0]) - float(kept.contraction()[0])
