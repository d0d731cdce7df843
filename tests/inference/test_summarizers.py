"""Summaries computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.inference import summarizers

STATES = jnp.asarray([[0.0, 1.0], [1.0, 1.0], [3.0, 0.0], [6.0, 0.0]])  # T = 3, S = 2
ACTIONS = jnp.asarray([[1.0], [2.0], [-1.0]])


@pytest.fixture(autouse=True)
def strict():
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        yield


def test_start_is_the_whole_trajectory_time_major():
    x = summarizers.summary_start(STATES, ACTIONS)
    np.testing.assert_array_equal(x, [0, 1, 1, 1, 1, 2, 3, 0, -1, 6, 0])
    np.testing.assert_array_equal(summarizers.summary_start(STATES, ACTIONS, steps=1), [0, 1, 1, 1, 1])


def test_corrdiff_is_the_inner_product_over_time_with_per_dimension_moments():
    x = summarizers.summary_corrdiff(STATES, ACTIONS)
    # tau = (1, 0), (2, -1), (3, 0):  <tau_0, a> = 1 + 4 - 3,  <tau_1, a> = -2
    np.testing.assert_allclose(x, [2.0, -2.0, 2.0, -1 / 3, 2 / 3, 2 / 9], rtol=1e-6)
    lagged = summarizers.summary_corrdiff(STATES, ACTIONS, lags=1)
    np.testing.assert_allclose(lagged[2:4], [2 * 1 + 3 * 2, -1 * 1], rtol=1e-6)


def test_corr_uses_the_states_before_the_actions():
    np.testing.assert_allclose(summarizers.summary_corr(STATES, ACTIONS)[:2], [0 + 2 - 3, 1 + 2 + 0])


def test_waypoints_span_the_trajectory():
    x = np.asarray(summarizers.summary_waypts(STATES, ACTIONS, waypoints=2)).reshape(2, 3)
    np.testing.assert_array_equal(x, [[0, 1, 1], [6, 0, -1]])


@pytest.mark.parametrize("name", summarizers.SUMMARIZERS)
def test_every_step_of_a_long_trajectory_counts_and_maps(name):
    rng = np.random.default_rng(0)
    states = jnp.asarray(rng.normal(size=(5, 41, 3)), jnp.float32)
    actions = jnp.asarray(rng.normal(size=(5, 40, 2)), jnp.float32)
    summarize = summarizers.get(name)
    x = jax.jit(jax.vmap(summarize))(states, actions)
    assert x.shape == (5, summarizers.size(summarize, 40, 3, 2)) and np.all(np.isfinite(x))
    late = jax.vmap(summarize)(states.at[:, 40].add(1.0), actions)
    assert not np.allclose(x, late)  # the very last state is seen


def test_names_are_checked():
    assert summarizers.get("start") is summarizers.summary_start
    assert summarizers.get("summary_corrdiff", lags=2)(STATES, ACTIONS).shape == (3 * 2 + 4,)
    with pytest.raises(ValueError, match="did you mean summary_corrdiff.*there are summary_start"):
        summarizers.get("summary_cordiff")
    with pytest.raises(ValueError, match="lags = 3"):
        summarizers.summary_corrdiff(STATES, ACTIONS, lags=3)
    with pytest.raises(ValueError, match=r"states \[T\+1, S\]"):
        summarizers.summary_start(STATES[:-1], ACTIONS)
