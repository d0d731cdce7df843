"""Coordinates that a network may take its summaries in."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.inference import InferenceSettings, whitening


def test_whitened_rows_have_unit_covariance_and_rows_left_out_do_not_count():
    x = jax.random.normal(jax.random.PRNGKey(0), (500, 3)) @ jnp.asarray([[3.0, 1, 0], [0, 1, 2], [0, 0, 1]])
    train = jnp.arange(500) < 400
    as_is, whitened = whitening.candidates(jnp.where(train[:, None], x, 1e3), train, 2)
    np.testing.assert_array_equal(as_is, np.eye(3))
    np.testing.assert_allclose(np.cov((x[:400] @ whitened).T), np.eye(3), atol=0.02)


def test_a_column_that_never_varies_stays_finite():
    x = jnp.stack([jnp.linspace(-1.0, 1.0, 50), jnp.zeros(50)], axis=1)
    assert np.all(np.isfinite(whitening.candidates(x, jnp.ones(50, bool), 2)))


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
    basis = np.asarray(whitening.candidates(first, used, 2, found)[1])
    signal = np.linalg.eigvalsh(np.cov((np.asarray(clean) @ basis).T))
    np.testing.assert_allclose(signal, [0, 0, 1, 1], atol=0.06)
    assert np.linalg.eigvalsh(np.cov((np.asarray(first) @ basis).T))[:2].max() < 0.02
