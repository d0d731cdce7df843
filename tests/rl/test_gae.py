"""Advantages against arithmetic done by hand."""

import jax.numpy as jnp
import numpy as np

from bayessim_mjx.rl.gae import gae


def test_hand_computed_plain_terminated_and_truncated():
    """gamma = lam = 1/2, value 1 everywhere, next values 1, 7, 2; worlds: unbroken, terminated, truncated at step 1."""
    column = np.ones((1, 3), np.float32)
    reward = jnp.array([[1.0], [2.0], [3.0]]) * column
    next_value = jnp.array([[1.0], [7.0], [2.0]]) * column
    next_value = next_value.at[1, 0].set(1.0)
    terminated = jnp.zeros((3, 3)).at[1, 1].set(1.0)
    truncated = jnp.zeros((3, 3)).at[1, 2].set(1.0)
    advantage, returns = gae(reward, jnp.ones((3, 3)), next_value, terminated, truncated, 0.5, 0.5)
    expected = np.array([
        # delta = 0.5, 1.5, 3: A2 = 3, A1 = 1.5 + 3/4, A0 = 0.5 + 2.25/4
        [1.0625, 2.25, 3.0],
        # delta1 = 2 - 1 = 1, nothing after it: A1 = 1, A0 = 0.5 + 1/4
        [0.75, 1.0, 3.0],
        # delta1 = 2 + 7/2 - 1 = 4.5, the sum is cut as well: A1 = 4.5, A0 = 0.5 + 4.5/4
        [1.625, 4.5, 3.0],
    ]).T  # fmt: skip
    np.testing.assert_array_equal(advantage, expected)
    np.testing.assert_array_equal(returns, expected + 1)


def test_lambda_one_is_the_discounted_return():
    reward, zeros = jnp.array([1.0, 2.0, 4.0]), jnp.zeros(3)
    terminated = zeros.at[2].set(1.0)
    value = jnp.array([0.3, -2.0, 5.0])
    _, returns = gae(reward, value, jnp.array([-2.0, 5.0, 9.0]), terminated, zeros, 0.5, 1.0)
    np.testing.assert_allclose(returns, [1 + 1 + 1, 2 + 2, 4], atol=1e-6)


def test_lambda_zero_is_the_one_step_error():
    reward, zeros = jnp.array([1.0, 2.0]), jnp.zeros(2)
    advantage, _ = gae(reward, jnp.array([1.0, 3.0]), jnp.array([3.0, 10.0]), zeros, zeros, 0.9, 0.0)
    np.testing.assert_allclose(advantage, [1 + 2.7 - 1, 2 + 9 - 3], rtol=1e-6)
