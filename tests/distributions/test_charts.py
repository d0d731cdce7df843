"""Distributions in probit and logit coordinates, conditioning and quotients: against grids and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from bayessim_mjx.distributions import Distribution, charts
from bayessim_mjx.inference.identify import restore_prior
from bayessim_mjx.inference.temperature import _spread
from bayessim_mjx.parameters import Parameter, ParameterSpace

MASS = Parameter("mass", 1.0, 0.5, 2.5)
LENGTH = Parameter("length", 1.0, 0.2, 4.0)
FRICTION = Parameter("friction", 0.1, 0.01, 1.0, prior="loguniform")
SPACE = ParameterSpace([MASS, LENGTH])
# a Gaussian prior whose box is 6 sd wide on each side: its probit coordinates are (theta - 1) / 0.5
NORMAL = ParameterSpace([Parameter(n, 1.0, -2.0, 4.0, prior="gaussian", mean=1.0, sd=0.5) for n in ("a", "b")])


pytestmark = pytest.mark.usefixtures("strict")


def key(seed: int = 0) -> jax.Array:
    return jax.random.PRNGKey(seed)


def grid(space: ParameterSpace, n: int) -> tuple[np.ndarray, float]:
    axes = [lo + (hi - lo) * (np.arange(n) + 0.5) / n for lo, hi in zip(space.low, space.high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(space))
    return points.astype(np.float32), float(np.prod((space.high - space.low) / n))


def some(space: ParameterSpace, chart: str, prior_weight: float = 0.2, seed: int = 0) -> Distribution:
    """Three correlated components, in the middle and towards the walls."""
    rng, d = np.random.default_rng(seed), len(space)
    means, spread = ((0.5, 0.3), 0.15) if chart == "plain" else ((0.0, 0.8), 0.5)
    scales = (
        np.tril(0.3 * spread * rng.normal(size=(3, d, d)), -1) + np.eye(d) * rng.uniform(0.5, 1, (3, d, 1)) * spread
    )
    centres = means[0] + means[1] * rng.normal(size=(3, d))
    return Distribution.from_unit(space, rng.normal(size=3), centres, scales, prior_weight, chart)


@pytest.mark.parametrize("chart", ["probit", "logit"])
def test_density_moments_and_draws_agree_with_a_grid(chart):
    space = ParameterSpace([MASS, FRICTION])
    q = some(space, chart)
    points, cell = grid(space, 400)
    weight = np.exp(np.asarray(q.log_prob(points), np.float64)) * cell
    assert weight.sum() == pytest.approx(1.0, abs=5e-3)
    mean = weight @ points
    np.testing.assert_allclose(q.mean(), mean, atol=5e-3)
    draws = np.asarray(q.sample(key(), 20000))
    assert np.all(draws >= space.low) and np.all(draws <= space.high)
    np.testing.assert_allclose(draws.mean(0), mean, atol=0.02)
    np.testing.assert_allclose(np.cov(draws.T), q.cov(), atol=0.01)
    assert np.isneginf(q.log_prob(np.asarray([0.4, 0.1], np.float32)))


def test_the_standard_normal_is_the_prior_in_the_probit_chart():
    q = Distribution.from_unit(SPACE, np.zeros(1), np.zeros((1, 2)), np.eye(2)[None], chart="probit")
    theta = q.sample(key(), 500)
    np.testing.assert_allclose(q.log_gain(theta), 0.0, atol=1e-4)
    np.testing.assert_allclose(q.contraction(), 0.0, atol=0.01)
    prior = Distribution.prior(SPACE, 3, "probit")
    np.testing.assert_allclose(prior.log_gain(theta), 0.0, atol=1e-6)
    twice = some(SPACE, "probit").product(q, prior, components=4)  # knowing nothing changes nothing
    np.testing.assert_allclose(twice.log_gain(theta), some(SPACE, "probit").log_gain(theta), atol=1e-3)


def test_the_gaussian_that_stands_for_the_prior_is_the_same_wherever_it_is_used():
    """Logit: moments 0 and 1 in the probit chart, by quadrature; and a temperature leaves knowing nothing alone."""
    x, w = np.polynomial.hermite_e.hermegauss(101)
    z = charts.NEUTRAL["logit"][1] * x
    probit = -np.sign(z) * special.ndtri_exp(-np.logaddexp(0.0, np.abs(z)))
    assert w @ probit**2 / w.sum() == pytest.approx(1.0, abs=1e-5)
    for chart in ("probit", "logit"):
        q = restore_prior(some(SPACE, chart), jnp.asarray([True, False]))
        means, scales = _spread(q, 2.0)
        np.testing.assert_allclose(means[:, 1], charts.NEUTRAL[chart][0], atol=1e-6)
        np.testing.assert_allclose(scales[:, 1, 1], charts.NEUTRAL[chart][1], rtol=1e-5)


@pytest.mark.parametrize("chart", ["plain", "probit"])
def test_a_product_equals_the_normalised_product_on_a_grid(chart):
    a, b = some(SPACE, chart, 0.3, 1), some(SPACE, chart, 0.1, 2)
    points, cell = grid(SPACE, 300)
    exact = np.exp(np.asarray(a.log_gain(points) + b.log_prob(points), np.float64))
    exact /= exact.sum() * cell
    got = np.exp(np.asarray(a.product(b, components=16).log_prob(points), np.float64))
    assert 0.5 * np.abs(got - exact).sum() * cell < 5e-3


def test_logit_distributions_are_carried_over_to_probit():
    q = some(SPACE, "logit", 0.0)
    points, cell = grid(SPACE, 300)
    density = [np.exp(np.asarray(v.log_prob(points), np.float64)) for v in (q, q.rechart("probit"))]
    assert 0.5 * np.abs(density[0] - density[1]).sum() * cell < 0.05
    assert q.product(q).chart == "probit"
    assert q.rechart("logit") is q
    with pytest.raises(ValueError, match="plain, probit, logit"):
        q.rechart("log")


def test_n_gaussian_posteriors_contract_as_one_over_root_n_with_a_gaussian_prior():
    """prior N(1, 0.5^2), x_i = theta + N(0, 0.4^2): precision 4 + n / 0.16, exactly."""
    x, n = np.asarray([1.3, 0.9, 1.6, 1.2, 1.45]), 5

    def posterior(x_sum, n):
        precision = 1 / 0.25 + n / 0.16
        return (1.0 / 0.25 + x_sum / 0.16) / precision, precision**-0.5

    def in_probit(mean, sd):
        return Distribution.from_unit(
            NORMAL, np.zeros(1), [[(mean - 1) / 0.5] * 2], [np.eye(2) * sd / 0.5], chart="probit"
        )

    rows = [in_probit(*posterior(v, 1)) for v in x]
    mean, sd = posterior(x.sum(), n)
    product = rows[0].product(*rows[1:])
    np.testing.assert_allclose(product.mean(), [mean, mean], atol=2e-3)
    np.testing.assert_allclose(product.sd(), [sd, sd], rtol=5e-3)


@pytest.mark.parametrize("prior_weight", [0.0, 0.3])
@pytest.mark.parametrize("chart", ["plain", "probit", "logit"])
def test_conditioning_on_any_dimension_is_a_slice_of_the_density(chart, prior_weight):
    q = some(SPACE, chart, prior_weight, 4)
    for i, (name, value) in enumerate([("mass", 1.1), ("length", 1.7)]):
        got = q.condition({name: value})
        assert got.names == (SPACE.names[1 - i],)
        points, cell = grid(got.space, 2000)
        full = np.insert(points, i, value, axis=1).astype(np.float32)
        exact = np.exp(np.asarray(q.log_prob(full), np.float64))
        exact /= exact.sum() * cell
        np.testing.assert_allclose(np.exp(got.log_prob(points)), exact, atol=5e-3 * exact.max())


def test_conditioning_of_three_parameters_on_the_middle_one():
    space = ParameterSpace([MASS, LENGTH, FRICTION])
    cov = np.asarray([[0.01, 0.03, 0.0], [0.03, 0.2, 0.04], [0.0, 0.04, 0.02]])
    mean = np.asarray([0.5, 0.4, 0.6])
    q = Distribution.from_unit(space, np.zeros(1), mean[None], np.linalg.cholesky(cov)[None])
    got = q.condition({"length": 2.1})
    gain = cov[[0, 2], 1] / cov[1, 1]
    np.testing.assert_allclose(got.means[0], mean[[0, 2]] + gain * (0.5 - 0.4), atol=1e-5)
    exact = cov[np.ix_([0, 2], [0, 2])] - np.outer(gain, cov[1, [0, 2]])
    np.testing.assert_allclose(got.scales[0] @ got.scales[0].T, exact, atol=1e-6)
    assert len(q.condition({"length": 2.1, "mass": 1.0}).space) == 1
    with pytest.raises(ValueError, match="mass = 9"):
        q.condition({"mass": 9.0})


@pytest.mark.parametrize("chart", ["plain", "probit"])
def test_dividing_by_the_proposal_undoes_multiplying_by_it(chart):
    """prior-proposal correction: (p(theta | x) p~ / p) p / p~ = p(theta | x), weights of the components included."""
    centre = 0.5 if chart == "plain" else 0.3
    proposal = Distribution.from_unit(SPACE, [0.0], [[centre, centre]], [[[0.2, 0], [0.1, 0.2]]], chart=chart)
    means = [[centre, 0.4], [centre - 0.1, 0.6], [0.45, centre]]
    scales = np.eye(2) * np.asarray([0.05, 0.08, 0.06])[:, None, None]
    truth = Distribution.from_unit(SPACE, np.log([0.5, 0.3, 0.2]), means, scales, chart=chart)
    tilted = truth.product(proposal, components=3)
    back, lost = tilted.divide(proposal)
    assert lost == 0.0
    theta = truth.sample(key(), 200)
    np.testing.assert_allclose(back.log_prob(theta), truth.log_prob(theta), atol=2e-3)


def test_components_broader_than_the_proposal_are_left_out_and_counted():
    proposal = Distribution.from_unit(SPACE, [0.0], [[0.5, 0.5]], [0.1 * np.eye(2)])
    scales = np.eye(2) * np.asarray([0.05, 0.3])[:, None, None]
    q = Distribution.from_unit(SPACE, np.log([0.6, 0.4]), [[0.5, 0.5]] * 2, scales)
    kept, lost = q.divide(proposal)
    assert lost == pytest.approx(0.4, abs=1e-6) and np.all(np.isfinite(kept.log_prob(SPACE.nominal)))
    wide = Distribution.from_unit(SPACE, [0.0], [[0.5, 0.5]], [0.3 * np.eye(2)])
    same, lost = wide.divide(proposal)
    assert same is wide and lost == pytest.approx(1.0)
    with pytest.raises(ValueError, match="reduce it to 1"):
        q.divide(q)
    with pytest.raises(ValueError, match="charts plain and probit"):
        q.divide(Distribution.prior(SPACE, 1, "probit"))


def test_the_chart_is_saved(tmp_path):
    q = some(SPACE, "probit")
    again = Distribution.load(q.save(tmp_path / "q.npz"), SPACE)
    assert again.chart == "probit"
    jax.tree.map(np.testing.assert_array_equal, again, q)
    marginal = again.marginal(["length"])
    points, cell = grid(marginal.space, 1000)
    assert np.exp(np.asarray(marginal.log_prob(points))).sum() * cell == pytest.approx(1.0, abs=2e-3)
    assert jnp.all((q.centres > 0) & (q.centres < 1))


def test_the_logit_of_a_normal_has_the_density_of_scipy():
    space = ParameterSpace([Parameter("x", 0.5, 0.0, 1.0)])
    q = Distribution.from_unit(space, [0.0], [[0.4]], [[[0.7]]], chart="logit")
    x = np.asarray([0.1, 0.5, 0.9])
    exact = stats.norm.logpdf(np.log(x / (1 - x)), 0.4, 0.7) - np.log(x) - np.log1p(-x)
    np.testing.assert_allclose(q.log_prob(x[:, None].astype(np.float32)), exact, atol=1e-4)
