"""Batches of small triangular problems against NumPy in float64."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import linalg


@pytest.mark.parametrize("d", [1, 3, 17])
def test_solve_and_inverse(d):
    rng = np.random.default_rng(d)
    lower = np.tril(rng.normal(size=(5, 2, d, d)), -1) * 0.3 + np.eye(d) * rng.uniform(0.5, 2.0, (5, 2, d, 1))
    right = rng.normal(size=(5, 2, d, 4))
    solved = linalg.solve_lower(jnp.asarray(lower, jnp.float32), jnp.asarray(right, jnp.float32))
    np.testing.assert_allclose(np.asarray(solved), np.linalg.solve(lower, right), rtol=2e-4, atol=2e-4)
    inverse = linalg.inverse_lower(jnp.asarray(lower, jnp.float32))
    np.testing.assert_allclose(np.asarray(inverse), np.linalg.inv(lower), rtol=2e-4, atol=2e-4)


@pytest.mark.parametrize("d", [1, 4, 17])
def test_lower_factor_is_the_cholesky_factor(d):
    rows = np.random.default_rng(d).normal(size=(6, d, 2 * d))
    factor = np.asarray(linalg.lower_factor(jnp.asarray(rows, jnp.float32)))
    np.testing.assert_allclose(factor, np.linalg.cholesky(rows @ np.swapaxes(rows, 1, 2)), rtol=1e-4, atol=2e-4)
    assert np.all(np.triu(factor, 1) == 0)


@pytest.mark.parametrize("d", [1, 2, 5, 8, 9])
def test_cholesky_written_out_and_not(d):
    rng = np.random.default_rng(d)
    rows = rng.normal(size=(7, 3, d, 2 * d))
    a = rows @ np.swapaxes(rows, -1, -2) + np.eye(d)
    below = jnp.asarray(a + np.triu(np.ones((d, d)), 1), jnp.float32)  # the lower triangle counts
    lower = np.asarray(linalg.cholesky(below))
    np.testing.assert_allclose(lower, np.linalg.cholesky(a), rtol=2e-4, atol=2e-4)
    if d <= linalg.UNROLLED:
        right = rng.normal(size=(7, 3, d))
        x = np.asarray(linalg.cholesky_solve(jnp.asarray(lower), jnp.asarray(right, jnp.float32)))
        np.testing.assert_allclose(x, np.linalg.solve(a, right[..., None])[..., 0], rtol=2e-3, atol=2e-4)
