"""Episode statistics: running sums across calls, a ring of the last finished ones."""

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.rl import episodes

ZEROS = jnp.zeros((4, 2))


def test_returns_and_lengths_by_hand_across_calls():
    """World 0 ends at its second step (return 3) and, in the next call, after 4 more (return 10)."""
    e = episodes.init(jnp.zeros(2))
    assert np.isnan(episodes.metrics(e)["Train/mean_reward"])
    reward = jnp.array([[1.0, 0.5], [2.0, 0.5], [3.0, 0.5], [4.0, 0.5]])
    e = episodes.update(e, reward, ZEROS.at[1, 0].set(1), ZEROS)
    assert episodes.metrics(e) == {"Train/mean_reward": 3.0, "Train/mean_episode_length": 2.0}
    np.testing.assert_array_equal(e.running_return, [7.0, 2.0])
    e = episodes.update(e, reward, ZEROS.at[1, 0].set(1), ZEROS.at[3, 1].set(1))
    assert e.finished == 3
    assert episodes.metrics(e)["Train/mean_reward"] == pytest.approx((3 + 10 + 4) / 3)
    assert episodes.metrics(e)["Train/mean_episode_length"] == pytest.approx((2 + 4 + 8) / 3)


def test_an_episode_cut_because_its_clock_was_late_does_not_count():
    e = episodes.init(jnp.ones(2))
    e = episodes.update(e, ZEROS + 1, ZEROS.at[2, 1].set(1), ZEROS.at[0, 0].set(1).at[3, 0].set(1))
    # world 0: cut after 1 step (not counted), then a whole one of 3; world 1: terminated after 3, which counts
    assert e.finished == 2
    assert episodes.metrics(e)["Train/mean_reward"] == 3.0


def test_the_window_holds_the_last_hundred():
    e = episodes.init(jnp.zeros(150))
    ones, values = jnp.ones((1, 150)), jnp.arange(150.0)[None]
    e = episodes.update(e, values, ones, 0 * ones)
    assert episodes.metrics(e)["Train/mean_reward"] == pytest.approx(np.arange(50, 150).mean())
    e = episodes.update(e, values.at[0, 30:].set(0), ones.at[0, 30:].set(0), 0 * ones)
    assert episodes.metrics(e)["Train/mean_reward"] == pytest.approx(
        (np.arange(80, 150).sum() + np.arange(30).sum()) / 100
    )
    assert e.finished == 180
