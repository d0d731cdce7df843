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
