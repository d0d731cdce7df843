"""Real summaries that simulation does not produce are flagged: shifted, noisier, and quieter than assumed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import checks, misspecification
from bayessim_mjx.inference.misspecification import Misfit, Scores, ranked
from bayessim_mjx.inference.range_ends import piles
from bayessim_mjx.parameters import Parameter, ParameterSpace

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

SPACE = ParameterSpace([Parameter("rate", 1.0, 0.5, 2.0), Parameter("size", 1.0, 0.2, 2.0)])
TIME = jnp.linspace(0.0, 3.0, 30)


def simulate(seed, n, noise=0.05, offset=0.0, late=0.0):
    """size sin(rate t), measured with noise."""
    key_u, key_x = jax.random.split(jax.random.PRNGKey(seed))
    theta = jax.vmap(SPACE.from_unit)(jax.random.uniform(key_u, (n, 2)))
    motion = theta[:, 1:] * jnp.sin(theta[:, :1] * jnp.maximum(TIME[None, :] - late, 0.0))
    return theta, motion + offset + noise * jax.random.normal(key_x, motion.shape)


@pytest.fixture(scope="module")
def detector():
    """real [200, 30] -> Misfit, by a network fitted on 3000 simulations."""
    thetas, x = simulate(0, 3000)
    settings = inference.InferenceSettings(components=3, hiddenLayers=(32, 32), max_steps=1000)
    state = inference.init(jax.random.PRNGKey(1), settings, SPACE, x.shape[1])
    state, _ = inference.fit(jax.random.PRNGKey(2), state, thetas, x)
    held = simulate(3, 400)[1]
    return lambda real: misspecification.detect(state, (thetas, x, 3000), held, real)


def test_nothing_is_flagged_where_nothing_is_wrong(detector):
    found = detector(simulate(4, 200)[1])
    assert np.mean(found.p <= 0.05) < 0.1
    # 1.95 / sqrt(200): 0.1 % by chance; the ranks are among the same 400 held-out ones, which adds to it
    assert kstest(found.p, "uniform").statistic < 0.17
    assert np.mean(found.features <= 0.05) < 0.07


@pytest.mark.parametrize(
    "wrong", [{"noise": 0.1}, {"noise": 0.025}, {"offset": 0.15}, {"late": 0.4}], ids=lambda w: "".join(w) + "changed"
)
def test_what_no_parameter_explains_is_flagged(detector, wrong):
    found = detector(simulate(5, 200, **wrong)[1])
    share = np.mean(found.p <= 0.05)
    assert share > 0.95, share
    assert found.flagged and found.sentence()
    if wrong.get("noise") == 0.025:
        assert "noise is assumed too large" in found.sentence() and np.mean(found.sides[:, 0] < 0) > 0.98


def test_p_values_by_ranks_are_exact():
    """Each of 250 tests with its own held-out scores; the scores depend on each other."""
    rng = np.random.default_rng(0)
    ps = []
    for _ in range(250):
        common = rng.normal(size=(100, 1))
        joint = common + rng.normal(size=(100, 3))
        features = rng.normal(size=(100, 2))
        ps.append(ranked(Scores(joint[1:], features[1:]), Scores(joint[:1], features[:1])).p[0])
    assert kstest(ps, "uniform").pvalue > 0.01


def test_a_summary_that_is_not_finite_is_the_most_unlikely():
    rng = np.random.default_rng(1)
    held = Scores(rng.normal(size=(99, 3)), rng.normal(size=(99, 2)))
    found = ranked(held, Scores(np.full((1, 3), np.nan), np.full((1, 2), np.nan)))
    assert found.p[0] == pytest.approx(0.01)


def test_the_combination_of_p_values():
    assert misspecification.combined(np.array([0.3])) == pytest.approx(0.3)
    assert misspecification.combined(np.array([0.001] + [0.5] * 9)) == pytest.approx(0.01, rel=0.05)
    assert misspecification.combined(np.full(5, 0.02)) == pytest.approx(0.02)


def test_distrust_mixes_the_prior_in():
    one = np.zeros((1, 3))
    sound, above, odd = (Misfit(np.array([p]), one, one, one, one, 99) for p in (0.05, 0.3, 0.01))
    assert sound.prior_share(0.5) == pytest.approx(0, abs=1e-9) and above.prior_share(0.5) == 0
    assert odd.prior_share(0.5) == pytest.approx(0.4)
    q = Distribution.gaussian(SPACE, [1.0, 1.0], 0.05)
    found, theta = checks.Checks(None, odd, (), (), odd.prior_share(0.5)), jnp.asarray([[1.0, 1.0], [1.9, 0.3]])
    mixed = found.guarded(q)
    expected = 0.6 * np.exp(q.log_gain(theta)) + 0.4
    np.testing.assert_allclose(np.exp(mixed.log_gain(theta)), expected, rtol=1e-4)


def test_mass_at_a_wall_is_told_with_the_way():
    (pile,) = piles(Distribution.gaussian(SPACE, [2.0, 1.0], [0.1, 0.1]))
    assert (pile.name, pile.upper) == ("rate", True) and pile.limit == pytest.approx(2.0)
    assert pile.mass > 0.5 and "upper end" in pile.sentence() and "raise its limit 2" in pile.sentence()
    (pile,) = piles(Distribution.gaussian(SPACE, [1.0, 0.2], [0.1, 0.1]))
    assert (pile.name, pile.upper) == ("size", False) and "reduce its limit 0.2" in pile.sentence()
    assert piles(Distribution.prior(SPACE)) == [] and piles(Distribution.gaussian(SPACE, [1.0, 1.0], 0.2)) == []


def test_directions_that_theta_moves_by_more_than_the_noise_weigh_most():
    """Signal of variance 4 and 1/9 along two oblique directions, none along the third: weights S / (1 + S)."""
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    signal = 7.0 + rng.normal(size=(20_000, 3)) * [2.0, 1 / 3, 0.0] @ turn.T
    used = np.arange(20_000) < 15_000
    signal[~used] = 1e3  # not looked at
    vectors, weight = misspecification._signal(jnp.asarray(signal, jnp.float32), jnp.asarray(used, jnp.float32))
    order = np.argsort(-np.asarray(weight))
    np.testing.assert_allclose(np.asarray(weight)[order], [0.8, 0.1, 0.0], atol=0.01)
    np.testing.assert_allclose(np.abs(np.asarray(vectors)[:, order].T @ turn), np.eye(3), atol=0.02)
