"""Policies with a memory: the cell by hand, sequences against single steps, and a task that nobody else can solve."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import recurrent
from bayessim_mjx.rollout import rollout
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=64, num_steps=8, num_epochs=4, num_minibatches=4, learning_rate=3e-3, schedule="fixed", gamma=0.5,
    hidden_actor=(16,), hidden_critic=(16,), max_iterations=80, log_interval=80, memory=8, shared_trunk=True,
)  # fmt: skip


class Recall(probes.Probe):
    """The first observation is +-1, the two others are 0; reward -(a - first / 2)^2 at the last step."""

    horizon = 3

    def first(self, key):
        return {"policy": jax.random.rademacher(key, (1,), jnp.float32)}

    def reset(self, key, theta=None):
        state = super().reset(key, theta)
        return state.replace(info={**state.info, "cue": state.obs["policy"][0]})

    def next(self, obs, steps):
        return {"policy": jnp.zeros(1)}

    def step(self, state, action):
        after = super().step(state, action)
        reward = -((action[0] - 0.5 * state.info["cue"]) ** 2) * (after.info["steps"] == 3)
        return after.replace(reward=reward)


def test_the_gated_unit_by_hand():
    """Reset gate sigma(0) = 1/2, update gate sigma(ln 3) = 3/4, candidate tanh(0.2 + 0.6 / 2): 0.25 tanh(0.5) + 0.3."""
    layer = {
        "x": {"w": jnp.array([[0.0, np.log(3), 0.2]]), "b": jnp.zeros(3)},
        "h": {"w": jnp.array([[0.0, 0.0, 1.5]]), "b": jnp.zeros(3)},
    }
    assert recurrent.gru(layer, jnp.array([0.4]), jnp.array([1.0]))[0] == pytest.approx(0.25 * np.tanh(0.5) + 0.3)


def test_the_lstm_by_hand():
    """x = 2, h = 0.5, c = 0.4; sigma(ln 3) = 3/4, sigma(-ln 3) = 1/4, sigma(0) = 1/2.

    Input gate sigma(ln 3) from x, forget gate sigma(-ln 3) from the bias, candidate tanh(0.1 x + 0.6 h) = tanh 0.5,
    output gate sigma(2 ln 3 h) from h: c' = 0.4 / 4 + 3/4 tanh 0.5, h' = 3/4 tanh c'.
    """
    layer = {
        "x": {"w": jnp.array([[np.log(3) / 2, 0.0, 0.1, 0.0]]), "b": jnp.array([0.0, -np.log(3), 0.0, 0.0])},
        "h": {"w": jnp.array([[0.0, 0.0, 0.6, 2 * np.log(3)]]), "b": jnp.zeros(4)},
    }
    memory = recurrent.lstm(layer, jnp.array([0.5, 0.4]), jnp.array([2.0]))
    cell = 0.1 + 0.75 * np.tanh(0.5)
    np.testing.assert_allclose(memory, [0.75 * np.tanh(cell), cell], rtol=1e-6)


def test_an_lstm_equals_flax():
    """Several units and inputs, against an implementation that is not ours."""
    linen = pytest.importorskip("flax.linen")
    layer, n = recurrent.init(jax.random.PRNGKey(0), 3, 4, "lstm"), 4
    np.testing.assert_array_equal(layer["x"]["b"], [0, 0, 0, 0, 1, 1, 1, 1] + [0] * 8)
    params = {}
    for i, gate in enumerate("ifgo"):
        part = slice(i * n, (i + 1) * n)
        params["i" + gate] = {"kernel": layer["x"]["w"][:, part]}
        params["h" + gate] = {"kernel": layer["h"]["w"][:, part], "bias": layer["x"]["b"][part]}
    memory, x = jax.random.normal(jax.random.PRNGKey(1), (5, 2 * n)), jax.random.normal(jax.random.PRNGKey(2), (5, 3))
    (cells, hidden), _ = linen.LSTMCell(n).apply({"params": params}, (memory[:, n:], memory[:, :n]), x)
    np.testing.assert_allclose(recurrent.lstm(layer, memory, x), jnp.concatenate([hidden, cells], -1), atol=1e-6)


@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_sequences_are_single_steps_that_begin_anew_where_an_episode_does(cell):
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    actor = {cell: recurrent.init(keys[0], 2, 4, cell)}
    size = recurrent.memory_size(actor)
    assert (size, recurrent.units(actor)) == ({"gru": 4, "lstm": 8}[cell], 4)
    observation = jax.random.normal(keys[1], (5, 3, 2))  # [T, N, S]
    ended = jnp.zeros((5, 3)).at[1, 0].set(1).at[3, 2].set(1)
    memory, before = jax.random.normal(keys[2], (3, size)), []
    for t in range(5):
        before.append(memory)
        after = recurrent.memories(actor, recurrent.Remembered(observation[t], memory))
        memory = after * (1 - ended[t])[:, None]
    steps = recurrent.Remembered(observation, jnp.stack(before))
    whole = jax.tree.map(lambda x: x.swapaxes(0, 1), recurrent.sequences(steps, ended))
    expected = recurrent.features(actor, steps).swapaxes(0, 1)
    assert expected.shape == (3, 5, 4)
    np.testing.assert_allclose(recurrent.features(actor, whole), expected, atol=1e-6)
    # the memories in the middle are of the collecting policy: they are not used
    forged = whole.replace(memory=whole.memory.at[1, 1:].set(9.0))
    np.testing.assert_allclose(recurrent.features(actor, forged), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("cell", "shared"),
    [
        ("lstm", True),
        pytest.param("gru", True, marks=[pytest.mark.slow, pytest.mark.ci]),
        pytest.param("lstm", False, marks=[pytest.mark.slow, pytest.mark.ci]),
    ],
)
def test_the_first_minibatch_sees_an_unchanged_policy(cell, shared):
    """Whatever the memories were, over several iterations and with ends of episodes in the middle of a sequence."""
    config = dataclasses.replace(
        CONFIG, num_epochs=1, num_minibatches=1, shared_trunk=shared, num_envs=16, memory_cell=cell
    )
    env = recurrent.remembering(probes.Walk(), config.memory_size)
    state, update = rl.init(env, config, jax.random.PRNGKey(0)), rl.make_update(env, config)
    for _ in range(4):
        state, metrics = update(state, None)
        assert metrics["Loss/kl"] < 1e-9
        assert metrics["Loss/clip_fraction"] == 0
    assert float(jnp.abs(state.env_states.obs["memory"]).max()) > 0.01


def learn(env, config):
    policy, _ = rl.train(env, config, jax.random.PRNGKey(0))
    return rl.evaluate(env, policy, jax.random.PRNGKey(1), jnp.zeros((64, 0)))["return"].mean(), policy


@pytest.mark.parametrize("cell", ["gru", pytest.param("lstm", marks=[pytest.mark.slow, pytest.mark.ci])])
def test_what_was_seen_before_is_remembered(cell):
    """Without a memory the best is to do nothing, -0.25."""
    config = dataclasses.replace(CONFIG, memory_cell=cell)
    env = recurrent.remembering(Recall(), config.memory_size)
    score, policy = learn(env, config)
    assert score > -0.02
    trajectory = rollout(env, policy.replace(deterministic=True), jax.random.PRNGKey(2), jnp.zeros((8, 0)), 3)
    np.testing.assert_allclose(trajectory.action[:, 2, 0], 0.5 * trajectory.observation[:, 0, 0], atol=0.2)


def test_without_a_memory_the_same_task_is_not_solved():
    score, _ = learn(Recall(), dataclasses.replace(CONFIG, memory=0))
    assert score < -0.2


def test_what_cannot_work_is_refused():
    with pytest.raises(UserError, match="ppo.memory = 8"):
        rl.init(probes.Walk(), CONFIG, jax.random.PRNGKey(0))
    with pytest.raises(UserError, match="ppo.memory_cell = 'rnn'.*gru, lstm"):
        dataclasses.replace(CONFIG, memory_cell="rnn")
    with pytest.raises(UserError, match="whole sequences.*num_envs = 2"):
        dataclasses.replace(CONFIG, num_envs=2)
