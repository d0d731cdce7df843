"""Running moments: exact pooling, neutral at the start."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.rl import normalise


def test_golden_values():
    moments = normalise.update(normalise.init(2), jnp.array([[1.0, 10.0], [3.0, 20.0]]))
    np.testing.assert_allclose(moments.mean, [2, 15])
    np.testing.assert_allclose(moments.var, [1, 25])
    moments = normalise.update(moments, jnp.array([[5.0, 0.0], [7.0, 40.0], [9.0, 80.0]]))
    np.testing.assert_allclose(moments.mean, [5, 30], rtol=1e-6)
    np.testing.assert_allclose(moments.var, [8, 800], rtol=1e-6)
    assert moments.count == 5


def test_pooled_moments_equal_those_of_all_samples():
    x = 3 + 2 * jax.random.normal(jax.random.PRNGKey(0), (7, 50, 4))
    moments = normalise.init(4)
    for part in (x[:1], x[1:4], x[4:]):
        moments = normalise.update(moments, part)
    np.testing.assert_allclose(moments.mean, np.asarray(x).mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(moments.var, np.asarray(x).var((0, 1)), rtol=1e-4)
    z = normalise.normalise(moments, x)
    np.testing.assert_allclose(z.mean((0, 1)), 0, atol=1e-4)
    np.testing.assert_allclose(z.std((0, 1)), 1, atol=1e-3)


def test_without_samples_observations_stay_as_they_are():
    x = jnp.array([[-2.0, 0.5]])
    np.testing.assert_allclose(normalise.normalise(normalise.init(2), x), x, rtol=2e-4)


def test_a_constant_feature_stays_finite_when_it_moves():
    moments = normalise.update(normalise.init(1), jnp.ones((10, 1)))
    assert normalise.normalise(moments, jnp.array([1.0])) == 0
    assert normalise.normalise(moments, jnp.array([2.0])) == normalise.LIMIT
