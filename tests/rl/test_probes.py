"""Five probe environments and the time limit: what the trainer must learn is known, and takes seconds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import networks, normalise
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=64, num_steps=8, num_epochs=4, num_minibatches=4, learning_rate=3e-3, schedule="fixed", gamma=0.9,
    hidden_actor=(16,), hidden_critic=(16,), use_clipped_value_loss=False, max_iterations=60, log_interval=60,
)  # fmt: skip
OBSERVATIONS = jnp.array([[-1.0], [0.0], [1.0]])


def learn(env, **changes):
    """The trained state, and the mean actions and values at observations -1, 0 and 1."""
    config = dataclasses.replace(CONFIG, **changes)
    state, metrics = rl.run(env, config, rl.init(env, config, jax.random.PRNGKey(0)))
    x = normalise.normalise(state.normalizer["policy"], OBSERVATIONS) if config.normalize_observations else OBSERVATIONS
    values = networks.value(state.params, x, networks.activation(config.activation))
    return rl.policy_of(state).act(None, OBSERVATIONS)[:, 0], values, metrics


def test_constant_reward():
    _, values, metrics = learn(probes.ConstantReward())
    assert values[1] == pytest.approx(1.0, abs=0.02)
    assert (metrics["Train/mean_reward"], metrics["Train/mean_episode_length"]) == (1.0, 1.0)


def test_reward_scale_is_for_the_learner_alone():
    _, values, metrics = learn(probes.ConstantReward(), reward_scale=0.25)
    assert values[1] == pytest.approx(0.25, abs=0.02)
    assert metrics["Train/mean_reward"] == 1.0


def test_value_follows_the_observation():
    _, values, metrics = learn(probes.ObservationValue())
    np.testing.assert_allclose(values[jnp.array([0, 2])], [-1, 1], atol=0.05)
    assert metrics["Loss/explained_variance"] > 0.9


def test_delayed_reward_is_discounted():
    _, values, _ = learn(probes.DelayedReward())
    np.testing.assert_allclose(values[1:], [0.9, 1.0], atol=0.03)


@pytest.mark.parametrize("clip", [False, True])
def test_advantage_reaches_the_actor(clip):
    actions, values, metrics = learn(probes.ActionReward(), use_clipped_value_loss=clip)
    assert actions[1] == pytest.approx(0.5, abs=0.05)
    assert values[1] == pytest.approx(0.0, abs=0.05)
    assert metrics["Train/mean_reward"] > -0.05
    assert metrics["Policy/mean_std"] < 0.3


def test_actions_follow_the_observation():
    actions, _, _ = learn(probes.ObservationAction())
    np.testing.assert_allclose(actions[jnp.array([0, 2])], [-0.5, 0.5], atol=0.08)


def test_adaptive_schedule_learns_it_too():
    actions, _, metrics = learn(probes.ObservationAction(), schedule="adaptive", learning_rate=1e-3)
    np.testing.assert_allclose(actions[jnp.array([0, 2])], [-0.5, 0.5], atol=0.08)
    assert 0.001 < metrics["Loss/kl"] < 0.03


def test_a_time_limit_does_not_shorten_the_future():
    """Reward 1 for ever at gamma 0.9: value 10, although every episode is cut after 5 steps."""
    _, values, metrics = learn(probes.TimeLimit(), max_iterations=150)
    assert values[1] == pytest.approx(10.0, abs=0.3)
    assert metrics["Train/mean_episode_length"] == 5.0
