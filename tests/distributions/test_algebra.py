"""Products of mixtures against the product of their densities, whatever widths and weights a network puts out."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from bayessim_mjx.distributions import Distribution, algebra
from bayessim_mjx.distributions.algebra import Mixture
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("a", 0.5, 0.0, 1.0), Parameter("b", 0.5, 0.0, 1.0)])


def log_density(mixture: Mixture, x: np.ndarray) -> np.ndarray:
    """Of the mixture at x [n, d], term by term, the common factor included."""
    d = x.shape[1]
    terms = [np.full(len(x), mixture.flat)]
    if mixture.prior:
        terms[0] = terms[0] - 0.5 * np.sum(x**2, axis=1) - 0.5 * d * np.log(2 * np.pi)
    for weight, mean, scale in zip(mixture.log_weights, mixture.means, mixture.scales, strict=True):
        z = solve_triangular(scale, (x - mean).T, lower=True)
        norm = np.sum(np.log(np.diag(scale))) + 0.5 * d * np.log(2 * np.pi)
        terms.append(weight - 0.5 * np.sum(z**2, axis=0) - norm)
    return logsumexp(terms, axis=0)


def random_mixture(rng: np.random.Generator, d: int, prior: float, narrowest: float, widest: float) -> Mixture:
    """Components of any shape with standard deviations between these and weights down to 1e-11."""
    k = int(rng.integers(1, 5))
    rotation = np.linalg.qr(rng.normal(size=(k, d, d)))[0]
    sd = 10 ** rng.uniform(np.log10(narrowest), np.log10(widest), size=(k, 1, d))
    scales = algebra.root(np.swapaxes(rotation * sd, -1, -2))
    means = rng.normal(size=(k, d)) if prior else rng.uniform(*((-0.2, 1.2) if widest > 1 else (0.1, 0.9)), size=(k, d))
    flat = rng.choice([-np.inf, rng.uniform(-20, 0)])
    return Mixture(float(flat), rng.uniform(-25, 0, size=k), means, scales, prior)


def draws(rng: np.random.Generator, mixture: Mixture, n: int) -> np.ndarray:
    which = rng.choice(len(mixture.means), n, p=np.exp(mixture.log_weights - logsumexp(mixture.log_weights)))
    noise = rng.normal(size=(n, mixture.means.shape[1], 1))
    return mixture.means[which] + (mixture.scales[which] @ noise)[..., 0]


@pytest.mark.parametrize("prior", [0.0, 1.0])
def test_the_product_is_the_product_of_the_densities_at_every_point(prior):
    """100 pairs, widths over eight decades (no probit component is broader than the prior): equal up to a factor."""
    rng, seen = np.random.default_rng(int(prior)), 0
    for _ in range(100):
        d = int(rng.integers(1, 6))
        a, b = (random_mixture(rng, d, prior, 1e-4, 1.0 if prior else 1e4) for _ in range(2))
        product = algebra.product(a, b)
        assert np.all(np.isfinite(product.scales)) and np.diagonal(product.scales, axis1=1, axis2=2).min() > 0
        x = draws(rng, product, 40)
        x = x if prior else x[np.all((x > 0) & (x < 1), axis=1)]
        if len(x) < 2:
            continue
        p = -0.5 * np.sum(x**2, axis=1) if prior else 0.0
        off = log_density(product, x) - (log_density(a, x) + log_density(b, x) - p)
        np.testing.assert_allclose(off - off[0], 0.0, atol=1e-3)
        seen += 1
    assert seen > 30


def test_gaussians_of_very_different_widths_by_hand():
    """Precisions add: 1e-7 and 1e3 give 1e-7; two of 1e-6 at .2 and .8 meet at .5 with 1e-6 / sqrt(2)."""
    one = lambda mean, sd: Mixture(-np.inf, np.zeros(1), np.array([[mean]]), np.array([[[sd]]]))  # noqa: E731
    for left, right, mean, sd in [
        ((0.3, 1e-7), (0.9, 1e3), 0.3, 1e-7),
        ((0.2, 1e-6), (0.8, 1e-6), 0.5, 1e-6 / 2**0.5),
        ((0.2, 0.1), (0.6, 0.2), 0.28, 0.02**0.5 * 2**0.5 * 0.2 / 0.5**0.5 * 0.5),
    ]:
        found = algebra.product(one(*left), one(*right))
        assert found.means[0, 0] == pytest.approx(mean, rel=1e-5)
        expected = (left[1] ** -2 + right[1] ** -2) ** -0.5
        assert found.scales[0, 0, 0] == pytest.approx(expected, rel=1e-2 if sd < 1e-6 else 1e-4)


def test_the_quotient_undoes_the_product_for_any_widths():
    rng = np.random.default_rng(3)
    for prior in (0.0, 1.0):
        for _ in range(50):
            d = int(rng.integers(1, 5))
            a = random_mixture(rng, d, prior, 1e-4, 0.5)._replace(flat=-np.inf)
            proposal = random_mixture(rng, d, prior, 0.3, 0.9)
            mean, scale = proposal.means[0], proposal.scales[0]
            tilted = algebra.product(a, Mixture(-np.inf, np.zeros(1), mean[None], scale[None], prior))
            back, lost = algebra.divide(tilted, mean, scale)
            x = draws(rng, back, 30)
            off = log_density(back, x) - log_density(a, x)
            inside = np.all((x > 0) & (x < 1), axis=1) if not prior else np.ones(len(x), bool)
            assert lost == 0.0
            if inside.any():
                np.testing.assert_allclose((off - off[inside][0])[inside], 0.0, atol=2e-3)


def nonsense(rng: np.random.Generator, d: int) -> np.ndarray:
    """A scale as networks put out where nothing trains them: float32, rows over twenty decades."""
    scale = np.tril(rng.normal(size=(d, d)) * 10 ** rng.uniform(-12, 9, size=(d, 1)))
    scale[np.diag_indices(d)] = 10 ** rng.uniform(-18, 9, size=d)
    return scale.astype(np.float32).astype(float)


def test_no_component_can_break_a_product_or_a_reduction():
    """100 pairs with a component of weight 5e-21, or of any weight, that no arithmetic stands: the others decide."""
    rng = np.random.default_rng(4)
    for i in range(100):
        d, prior = int(rng.integers(2, 5)), float(i % 2)
        a, b = (random_mixture(rng, d, prior, 1e-2, 0.3) for _ in range(2))
        faint = np.log(5e-21) if i % 4 < 2 else rng.uniform(-20, 0)
        bad = [
            m._replace(
                log_weights=np.append(m.log_weights, m.log_weights.max() + faint),
                means=np.append(m.means, 10 ** rng.uniform(-3, 8) * rng.normal(size=(1, d)), 0),
                scales=np.append(m.scales, nonsense(rng, d)[None], 0),
            )
            for m in (a, b)
        ]
        found = algebra.product(*bad)
        if i % 4 < 2:
            clean, x = algebra.product(a, b), 0.5 + 0.1 * rng.normal(size=(5, d))
            np.testing.assert_allclose(log_density(found, x), log_density(clean, x), atol=1e-3, rtol=1e-6)
        for part in (found, algebra.reduce(found, 3), algebra.reduce(algebra.product(found, bad[0]), 2)):
            assert np.isfinite(part.means).all() and np.isfinite(part.scales).all() and len(part.means) > 0
            assert np.diagonal(part.scales, axis1=1, axis2=2).min() > 0


def test_the_heaviest_component_is_never_dropped():
    scales = np.tile(np.eye(2), (3, 1, 1))
    for weights in ([np.nan, np.nan, -3.0], [np.nan] * 3, [-1e12] * 3):
        for flat in (-np.inf, 0.0):
            assert len(algebra.prune(Mixture(flat, np.array(weights), np.zeros((3, 2)), scales)).means) >= 1


def test_merging_keeps_the_moments_of_thin_and_broad_components():
    rng = np.random.default_rng(5)
    for _ in range(20):
        m = random_mixture(rng, 3, 1.0, 1e-5, 1.0)._replace(flat=-np.inf)
        weights = np.exp(m.log_weights - logsumexp(m.log_weights))
        small = algebra.reduce(m._replace(log_weights=np.log(np.maximum(weights, 1e-7))), 1)
        weights = np.maximum(weights, 1e-7) / np.maximum(weights, 1e-7).sum()
        mean = weights @ m.means
        gap = m.means - mean
        cov = np.einsum("k,kij,klj->il", weights, m.scales, m.scales) + np.einsum("k,ki,kj->ij", weights, gap, gap)
        np.testing.assert_allclose(small.means[0], mean, atol=1e-6)
        np.testing.assert_allclose(small.scales[0] @ small.scales[0].T, cov, atol=1e-6)


@pytest.mark.parametrize("chart", ["plain", "probit"])
def test_distributions_with_a_broken_component_multiply(chart):
    """Whole way through float32, from a network's numbers to draws of the product."""
    rng = np.random.default_rng(6)
    good, bad = ([np.diag([0.05, 0.1]), np.diag([0.1, 0.2])], nonsense(rng, 2))
    bad[0, 0], bad[1] = 1e-9, (2e8, 3.0)
    means = [[0.4, 0.5], [0.45, 0.6], [0.5, 0.5]]
    logits = np.log([0.6, 0.4, 5e-21])
    q = Distribution.from_unit(SPACE, logits, means, [*good, bad], 0.05, chart)
    clean = Distribution.from_unit(SPACE, np.log([0.6, 0.4, 1e-12]), means, [*good, good[0]], 0.05, chart)
    found, expected = q.product(q, q), clean.product(clean, clean)
    np.testing.assert_allclose(found.mean(), expected.mean(), atol=1e-3)
    np.testing.assert_allclose(found.cov(), expected.cov(), atol=1e-5)
    assert found.sound and q.sound


def test_what_is_no_density_is_not_sound():
    scales = 0.1 * np.tile(np.eye(2), (2, 1, 1))
    q = Distribution.from_unit(SPACE, np.log([0.5, 0.5]), [[0.4, 0.4], [0.6, 0.6]], scales, 0.05)
    assert q.sound and Distribution.prior(SPACE, 3).sound
    flat, thin = (np.where(np.eye(2, dtype=bool), v, q.scales) for v in (0.0, -0.1))
    for change in (
        {"scales": flat}, {"scales": thin}, {"prior_weight": 1.2}, {"prior_weight": -0.1}, {"prior_weight": np.nan},
        {"means": q.means.at[0, 1].set(np.nan)}, {"log_inside": -np.inf}, {"logits": np.full(2, -np.inf)},
        {"logits": np.array([np.nan, 0.0])},
    ):  # fmt: skip
        broken = dataclasses.replace(q, **change)
        assert not broken.sound, change
        with pytest.raises(ValueError, match="no density"):
            q.product(broken)


def test_posteriors_that_lie_outside_in_several_directions_and_contradict_each_other_do_not_end_as_the_prior():
    """Each is a sliver in the corner of three parameters; in the fourth they are 40 standard deviations apart.

    All together they hardly have any mass: what is left are the single ones, each of which is (1 - w) w^2, and w^3.
    """
    space = ParameterSpace([Parameter(f"p{i}", 0.5, 0.0, 1.0) for i in range(4)])
    sd, w = jnp.diag(jnp.array([0.02, 0.02, 0.02, 0.005])), 0.05

    def factor(at: float) -> Distribution:
        return Distribution.from_unit(space, jnp.zeros(1), jnp.array([[-0.5, -0.5, -0.5, at]]), sd[None], w)

    found = factor(0.3).product(factor(0.5), factor(0.7), components=4)
    assert float(found.prior_weight) == pytest.approx(w / (w + 3 * (1 - w)), rel=0.02)
    for at in (0.3, 0.5, 0.7):  # density of each, and of a third of their sum
        theta = jnp.array([0.001, 0.001, 0.001, at])
        assert float(found.log_gain(theta)) == pytest.approx(float(factor(at).log_gain(theta)) - np.log(3), abs=0.1)


def test_masses_in_the_cube_are_those_of_independent_coordinates_also_far_outside():
    means, sds = np.array([[0.5, 0.2], [-0.5, 1.4], [1.02, 0.5]]), np.array([[0.3, 0.1], [0.02, 0.03], [0.01, 2.0]])
    far = stats.norm.logsf(25)  # of a mean half a range outside, at .02; the other wall adds nothing
    inside = np.log(np.diff(stats.norm.cdf([-5 / 3, 5 / 3]))[0]), np.log(np.diff(stats.norm.cdf([-2.0, 8.0]))[0])
    flat = np.log(np.diff(stats.norm.cdf([-0.25, 0.25]))[0])
    want = [sum(inside), far + stats.norm.logsf(0.4 / 0.03), stats.norm.logsf(2) + flat]
    found = algebra.log_masses(means, np.stack([np.diag(s) for s in sds]))
    np.testing.assert_allclose(found, want, rtol=1e-6)
    # correlated: the exact mass of N((1/2, 1/2), sd 1/2, correlation .8) by scipy
    cov = 0.25 * np.array([[1, 0.8], [0.8, 1]])
    exact = stats.multivariate_normal([0.5, 0.5], cov).cdf([1, 1], lower_limit=[0, 0])
    assert algebra.log_masses(np.full((1, 2), 0.5), np.linalg.cholesky(cov)[None])[0] == pytest.approx(
        np.log(exact), abs=0.03
    )
