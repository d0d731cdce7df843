"""The verdict on posteriors that are exact, or deliberately too narrow, too wide and shifted; p-values are uniform."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import calibration, restore_prior
from bayessim_mjx.inference.temperature import tempered
from bayessim_mjx.parameters import Parameter, ParameterSpace

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SPACE = ParameterSpace([Parameter("a", 0.0, -1.0, 1.0), Parameter("b", 5.0, 0.0, 10.0)])
MIXING = np.array([[1.0, 0.4], [0.0, 1.0]])
COV = 0.15**2 * np.linalg.inv(MIXING.T @ MIXING)  # of u given x = MIXING u + N(0, 0.15^2 I), in unit coordinates
PAIRS = 300


def posteriors(seed, scale=1.0, shift=(0.0, 0.0)):
    """(exact posteriors of PAIRS draws from the prior, changed as said; the truths). Exact: Gaussian cut to the box."""
    key_u, key_x = jax.random.split(jax.random.PRNGKey(seed))
    u = jax.random.uniform(key_u, (PAIRS, 2))
    x = u @ MIXING.T.astype(np.float32) + 0.15 * jax.random.normal(key_x, (PAIRS, 2))
    means = x @ np.linalg.inv(MIXING).T.astype(np.float32) + jnp.asarray(shift, jnp.float32)[None, :]
    factor = jnp.asarray(scale * np.linalg.cholesky(COV), jnp.float32)
    build = jax.jit(jax.vmap(lambda m: Distribution.from_unit(SPACE, jnp.zeros(1), m[None], factor[None])))
    return build(means), jax.vmap(SPACE.from_unit)(u)


def report(seed, **change):
    return calibration.check(jax.random.PRNGKey(100 + seed), *posteriors(seed, **change))


@pytest.fixture(scope="module")
def exact():
    return [report(seed) for seed in range(20)]


def test_exact_posteriors_are_called_calibrated(exact):
    assert sum(r.verdict == calibration.CALIBRATED for r in exact) >= 19  # 1 % each
    shares = np.mean([[r.coverage[level][0] for level in calibration.LEVELS] for r in exact], axis=0)
    errors = [exact[0].coverage[level][1] / np.sqrt(len(exact)) for level in calibration.LEVELS]
    assert np.all(np.abs(shares - calibration.LEVELS) < 3.5 * np.asarray(errors))


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({"scale": 0.7}, calibration.OVER),
        ({"scale": 1.5}, calibration.UNDER),
        ({"shift": (0.0, 0.09)}, calibration.BIASED),
    ],
)
def test_wrong_posteriors_are_caught(change, verdict):
    reports = [report(seed, **change) for seed in range(5)]
    assert all(r.verdict == verdict for r in reports), [r.words for r in reports]
    if verdict == calibration.BIASED:
        # the box cuts what is shifted in b off in a too: one standard error there, for nine in b
        assert all("b (the truth is below)" in r.words for r in reports)
        assert sum("a (" in r.words for r in reports) <= 1


@pytest.mark.parametrize(
    ("scale", "verdict"), [(1.0, calibration.CALIBRATED), (0.6, calibration.OVER), (1.8, calibration.UNDER)]
)
def test_parameters_at_the_prior_do_not_hide_what_is_wrong_with_the_others(scale, verdict):
    """Twelve of fourteen are at the prior: of the Gaussians that stand for it hardly any draw is in the box."""
    space = ParameterSpace([*SPACE.parameters, *(Parameter(f"none{i}", 0.5, 0.0, 1.0) for i in range(12))])
    q, theta = posteriors(4, scale)

    def beside(q):
        means, scales = (
            jnp.pad(q.means, ((0, 0), (0, 12)), constant_values=0.5),
            jnp.pad(q.scales, ((0, 0), (0, 12), (0, 12))),
        )
        wide = Distribution.from_unit(
            space, q.logits, means, scales + jnp.diag(jnp.where(jnp.arange(14) < 2, 0.0, 0.3))
        )
        return restore_prior(wide, jnp.arange(14) < 2)

    more = jax.random.uniform(jax.random.PRNGKey(8), (PAIRS, 12))
    found = calibration.check(jax.random.PRNGKey(1), jax.vmap(beside)(q), jnp.concatenate([theta, more], axis=1))
    assert found.verdict == verdict, found.words
    exact = calibration.check(jax.random.PRNGKey(1), q, theta)
    for level in calibration.LEVELS:
        assert found.coverage[level][0] == pytest.approx(exact.coverage[level][0], abs=3 * exact.coverage[level][1])


def test_p_values_are_uniform_where_nothing_is_wrong(exact):
    p = np.array([list(r.p.values()) for r in exact])
    assert kstest(p[:, :2].ravel(), "uniform").pvalue > 0.001 and kstest(p[:, 3], "uniform").pvalue > 0.001
    draws = np.random.default_rng(0).random((250, 100))
    assert kstest([calibration.uniform_p(row) for row in draws], "uniform").pvalue > 0.01
    # its 5 % point is 2.492 for any n (Stephens 1974)
    assert np.quantile(calibration._null(100), 0.95) == pytest.approx(2.492, abs=0.15)


def test_ranks_are_uniform_also_where_the_prior_is_mixed_in():
    q, theta = posteriors(3)
    mixed = dataclasses.replace(q, prior_weight=jnp.full(PAIRS, 0.3))
    fresh = jax.jit(jax.vmap(lambda key, q: q.sample(key, 1)[0]))(jax.random.split(jax.random.PRNGKey(9), PAIRS), mixed)
    found = calibration.check(jax.random.PRNGKey(1), mixed, fresh)  # theta drawn from q itself: exact by construction
    assert found.verdict == calibration.CALIBRATED and min(found.p.values()) > 0.001


def test_a_temperature_undoes_what_was_too_narrow():
    q, theta = posteriors(5, scale=0.6)
    found = calibration.corrected(jax.random.PRNGKey(0), q, theta)
    assert found.before == calibration.OVER and found.verdict == calibration.CALIBRATED
    assert found.temperature == pytest.approx(1 / 0.6, rel=0.2)
    assert "standard deviations times" in found.words and found.pairs == PAIRS // 2 and found.densities == PAIRS
    assert calibration.corrected(jax.random.PRNGKey(0), *posteriors(5)).temperature is None


def test_contraction_is_that_of_the_exact_posterior(exact):
    # draws cut by the box are a little narrower than sqrt(COV); var of the prior is 1/12 in unit coordinates
    expected = 1 - np.diag(COV) * 12
    assert np.all(exact[0].contraction > expected - 0.02) and np.all(exact[0].contraction < expected + 0.15)


def test_too_few_pairs_are_refused():
    q, theta = posteriors(0)
    nothing = jax.tree.map(lambda leaf: jnp.full_like(leaf, jnp.nan), q)
    with pytest.raises(ValueError, match="0 usable pairs"):
        calibration.check(jax.random.PRNGKey(0), nothing, theta)


def test_the_predictive_check_notices_replicates_that_lie_elsewhere():
    rng = np.random.default_rng(0)
    x, again = rng.normal(size=(200, 5)), rng.normal(size=(200, 10, 5))
    p, features = calibration.predictive(x, again)
    assert p > 0.01
    p, features = calibration.predictive(x, again + np.array([0, 0, 0.7, 0, 0]))
    assert p < 1e-3 and np.argmin(features) == 2


@pytest.mark.parametrize("chart", ["plain", "probit"])
def test_a_temperature_widens_up_to_the_prior(chart):
    """probit: (q / p)^(1 / f^2) p has precision (P - 1) / f^2 + 1; plain: sd times f."""
    q = Distribution.from_unit(SPACE, jnp.zeros(1), jnp.full((1, 2), 0.4), 0.05 * jnp.eye(2)[None], 0.0, chart)
    wide = tempered(q, 2.0)
    if chart == "plain":
        np.testing.assert_allclose(wide.scales[0], 0.1 * np.eye(2), rtol=1e-5)
        return
    precision = (1 / 0.05**2 - 1) / 4 + 1
    np.testing.assert_allclose(wide.scales[0], precision**-0.5 * np.eye(2), rtol=1e-4)
    np.testing.assert_allclose(wide.means[0], 0.4 / 0.05**2 / 4 / precision, rtol=1e-4)
    flat = tempered(q, 1e4)  # nothing is left but the prior
    np.testing.assert_allclose(flat.contraction(), [0.0, 0.0], atol=0.01)


def test_pairs_from_a_proposal_are_ranked_among_draws_of_the_posterior_that_belongs_to_it():
    """Truths drawn from a proposal that says more than the data: the draws are as narrow as both together."""
    tilt = Distribution.gaussian(SPACE, [0.4, 7.0], [0.15, 0.8])
    truth = tilt.sample(jax.random.PRNGKey(0), PAIRS)
    u = jax.vmap(SPACE.to_unit)(truth)
    noise = jnp.asarray(np.linalg.cholesky(COV * 4), jnp.float32)
    means = u + jax.random.normal(jax.random.PRNGKey(1), u.shape) @ noise.T
    q = jax.jit(jax.vmap(lambda m: Distribution.from_unit(SPACE, jnp.zeros(1), m[None], noise[None])))(means)
    found = calibration.check(jax.random.PRNGKey(2), q, truth, tilt=tilt)
    both = np.linalg.inv(np.linalg.inv(COV * 4) + np.diag(np.array([0.075, 0.08]) ** -2.0))
    assert found.verdict == calibration.CALIBRATED
    np.testing.assert_allclose(found.contraction, 1 - 12 * np.diag(both), atol=0.02)
    assert calibration.check(jax.random.PRNGKey(2), q, truth).contraction.max() < 0.8


def judged(narrow, wide=1.0, n=3000):
    """Ranks of truths among posteriors whose widths are these multiples in a and in b, alone and together."""
    rng = np.random.default_rng(0)
    pit = np.stack([0.5 + np.clip((rng.random(n) - 0.5) / width, -0.5, 0.5) for width in (narrow, wide)], axis=1)
    even = rng.random(n)
    return calibration.judge(calibration.Ranks(pit, even, rng.random(n), even, np.ones((n, 2))), SPACE)


def test_a_width_that_is_wrong_in_one_parameter_is_said_with_the_numbers_of_that_parameter():
    """The regions of all parameters hold enough: their numbers would contradict the verdict."""
    found = judged(0.8)
    test = ", by the spread of the ranks (p < 1e-9, a fault below 0.00125)"
    assert found.words == "over-confident: too narrow in a" + test
    assert found.evidence().startswith("intervals of a 50 %: 40") and "HPD" not in found.evidence()
    both = judged(0.7, 1.2)
    assert both.words == "over-confident: too narrow in a, too wide in b" + test
    assert "; intervals of b 50 %: 59" in both.evidence()
    assert judged(0.9, 1.4).words == "under-confident: too wide in b, too narrow in a" + test
    assert judged(1.0).evidence().startswith("HPD coverage 50 %: ")


def test_the_parameter_named_beside_the_regions_errs_as_they_do():
    """Too narrow together, and `most in` one that is too narrow, not in one that is too wide by more."""
    p = dict.fromkeys(("a", "b", "HPD level", "TARP"), 0.5)
    _, words, alone = calibration._verdict(("a", "b"), np.zeros(2), np.array([4.0, -9.0]), 5.0, p)
    assert words.startswith("over-confident: too narrow, most in a, by the mean HPD level (p = 5.7e-07, a fault")
    assert alone == ()


@pytest.mark.parametrize(
    ("bias", "spread", "level", "low", "words"),
    [
        (4.0, 0.0, 0.0, {}, "biased in a (the truth is above), by the mean of the ranks (p = 6.3e-05, a fault below"),
        (
            0.0,
            3.4,
            0.0,
            {"a": 0.0029},
            "too narrow in a, by the spread of the ranks (p = 0.00067, a fault below 0.00125",
        ),
        (0.0, 0.0, 0.0, {"TARP": 0.00024}, "the ranks of TARP are not uniform (p = 0.00024, a fault below 0.000625"),
    ],
)
def test_the_sentence_names_the_test_that_decides_its_p_and_its_limit(bias, spread, level, low, words):
    """By hand: 2 (1 - Phi(4)) = 6.3e-5, 2 (1 - Phi(3.4)) = 6.7e-4; a quarter of 1 %, shared by two, and by four."""
    p = dict.fromkeys(("a", "b", "HPD level", "TARP"), 0.5) | low
    assert words in calibration._verdict(("a", "b"), np.array([bias, 0]), np.array([spread, 0]), level, p)[1]


def test_calibrated_states_a_low_p_and_what_all_tests_make_of_it():
    """Corrected for all tests it lies between 1 and 5 %: the word alone would hide that."""
    p = dict.fromkeys(("a", "b", "HPD level", "TARP"), 0.5)
    none = np.zeros(2)
    assert calibration._verdict(("a", "b"), none, none, 0.0, p)[1] == "calibrated"
    assert calibration._verdict(("a", "b"), none, none, 0.0, p | {"a": 0.01})[1] == "calibrated"
    found = calibration._verdict(("a", "b"), none, none, 0.0, p | {"a": 0.0012})
    assert found[:2] == ("calibrated", "calibrated (lowest p 0.0012; corrected for all tests 0.019)")
