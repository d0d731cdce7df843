"""Coordinates that a network may take its summaries in."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import inference
from bayessim_mjx.inference import InferenceSettings, whitening
from bayessim_mjx.parameters import Parameter, ParameterSpace


def test_whitened_rows_have_unit_covariance_and_rows_left_out_do_not_count():
    x = jax.random.normal(jax.random.PRNGKey(0), (500, 3)) @ jnp.asarray([[3.0, 1, 0], [0, 1, 2], [0, 0, 1]])
    train = jnp.arange(500) < 400
    as_is, whitened = whitening.candidates(jnp.where(train[:, None], x, 1e3), x, train, 2)
    np.testing.assert_array_equal(as_is, np.eye(3))
    np.testing.assert_allclose(np.cov((x[:400] @ whitened).T), np.eye(3), atol=0.02)


def test_a_column_that_never_varies_stays_finite():
    x = jnp.stack([jnp.linspace(-1.0, 1.0, 50), jnp.zeros(50)], axis=1)
    assert np.all(np.isfinite(whitening.candidates(x, x, jnp.ones(50, bool), 2)))


def test_fourier_features_and_small_ensembles_keep_their_inputs():
    assert whitening.count(InferenceSettings(modelClass="MDRFF"), 10) == 1
    assert whitening.count(InferenceSettings(ensemble=1), 10) == 1
    assert whitening.count(InferenceSettings(), 10) == 2


def test_directions_of_noise_alone_are_turned_down_and_what_parameters_move_has_unit_variance():
    """Two directions far above the noise, one far below it (its variance 1/25 of the noise's), one of noise alone."""
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    count, noise = 20_000, jnp.asarray([0.1, 0.2, 0.1, 0.5])
    moved = jnp.asarray([[3.0, 1.0, 0.0, 0.0], [0.0, 0.5, 1.0, 0.0], [0.0, 0.0, 0.02, 0.0]])
    clean = jax.random.normal(keys[0], (count, 3)) @ moved
    first, second = (clean + noise * jax.random.normal(key, clean.shape) for key in keys[1:])
    used = jnp.arange(count) < count - 100
    spoilt = jnp.where(used[:, None], second, 1e3)  # what is not used does not count
    found = whitening.noise_of(first, spoilt, used)
    np.testing.assert_allclose(found, np.diag(noise**2), atol=0.01)
    basis = np.asarray(whitening.candidates(first, clean, used, 2, found)[1])
    signal = np.linalg.eigvalsh(np.cov((np.asarray(clean) @ basis).T))
    np.testing.assert_allclose(signal, [0, 0, 1, 1], atol=0.06)
    assert np.linalg.eigvalsh(np.cov((np.asarray(first) @ basis).T))[:2].max() < 0.02


def test_regressed_columns_say_parameters_and_squares_and_the_others_nothing():
    """Among 40 features of noise one is a line in the parameter, one its square about its middle."""
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    y = jax.random.uniform(keys[0], (4000, 1))
    x = jax.random.normal(keys[1], (4000, 42))
    x = x.at[:, 7].set(2.0 * y[:, 0] + 0.1 * x[:, 7]).at[:, 9].set(5.0 * (y[:, 0] - 0.5) ** 2 + 0.05 * x[:, 9])
    x = (x - x.mean(0)) / x.std(0)
    train = jnp.arange(4000) < 3000
    basis = whitening.regressed(jnp.where(train[:, None], x, 1e3), y, train)
    assert basis.shape == (42, 2)
    shown = np.asarray(x[3000:] @ basis)
    assert np.corrcoef(shown[:, 0], y[3000:, 0])[0, 1] > 0.97
    assert np.corrcoef(shown[:, 1], (y[3000:, 0] - 0.5) ** 2)[0, 1] > 0.95
    np.testing.assert_allclose(shown.std(0), 1.0, atol=0.05)


def test_very_many_features_are_regressed():
    settings = InferenceSettings()
    assert whitening.width(settings, 600, 17) == 34 and whitening.width(settings, 512, 17) == 512
    assert whitening.width(settings, 5000, 17) == 5000 and whitening.width(settings, 600, 400) == 600
    assert whitening.width(InferenceSettings(modelClass="MDRFF"), 600, 17) == 600
    assert whitening.count(settings, 600) == 1


def test_a_network_of_very_many_features_finds_the_few_that_tell():
    """One of 600 features is theta with noise of .05: at best a gain of log(1 / (.05 sqrt(2 pi e))) = 1.58 nats."""
    keys = jax.random.split(jax.random.PRNGKey(1), 3)
    space = ParameterSpace([Parameter("theta", 0.5, 0.0, 1.0)])
    theta = jax.random.uniform(keys[0], (3000, 1))
    x = jax.random.normal(keys[1], (3000, 600)).at[:, 123].set(theta[:, 0] + 0.05 * jax.random.normal(keys[2], (3000,)))
    settings = InferenceSettings(ensemble=2, components=2, hiddenLayers=(32,), max_steps=1000, restandardise=True)
    state = inference.init(keys[0], settings, space, 600)
    assert state.basis.shape == (600, 2) and inference.condition(state, x[:3]).means.shape == (3, 4, 1)
    for _ in range(2):  # the second goes on, with a regression of its own
        state, info = inference.fit(keys[1], state, theta[:2500], x[:2500])
    gains = jax.vmap(lambda q, t: q.log_gain(t))(inference.condition(state, x[2500:]), theta[2500:])
    assert 1.2 < float(jnp.mean(gains)) < 1.75


def test_many_features_may_be_regressed_and_then_fill_the_inputs_with_nothing():
    x, y = jax.random.normal(jax.random.PRNGKey(0), (900, 200)), jax.random.uniform(jax.random.PRNGKey(1), (900, 2))
    x = x.at[:, 5].set(3.4 * (y[:, 0] - 0.5))
    assert whitening.count(InferenceSettings(), 200) == 3 and whitening.width(InferenceSettings(), 200, 2) == 200
    *others, last = whitening.candidates(x, y, jnp.ones(900, bool), 3)
    assert bool(whitening.is_padded(last)) and not any(bool(whitening.is_padded(basis)) for basis in others)
    shown = np.asarray(x @ last)
    assert not shown[:, 4:].any()
    # four inputs that a layer for 200 sees as much of as of 200 with unit variance
    np.testing.assert_allclose(np.mean(np.sum(shown**2, axis=1)), 200.0, rtol=0.05)
    assert np.corrcoef(shown[:, 0], y[:, 0])[0, 1] > 0.99
