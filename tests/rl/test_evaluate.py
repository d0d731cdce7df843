"""Evaluation: whole episodes, deterministic unless told otherwise, compiled once."""

import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from tests.rl import probes

# the package has a function of this name
evaluation = importlib.import_module("bayessim_mjx.rl.evaluate")

CONFIG = PPOConfig(
    num_envs=16, num_steps=8, num_epochs=2, num_minibatches=2, hidden_actor=(8,), hidden_critic=(8,), log_interval=2
)


def key(seed):
    return jax.random.PRNGKey(seed)


def test_evaluation_runs_whole_episodes_deterministically_and_compiles_once():
    env = probes.Lifetime()
    policy, other = (rl.policy_of(rl.init(env, CONFIG, key(seed))) for seed in (0, 1))
    thetas = jnp.array([[1.0], [3.0], [7.0], [50.0]])
    result = rl.evaluate(env, policy, key(0), thetas)
    np.testing.assert_array_equal(result["return"], [1, 3, 7, 10])
    np.testing.assert_array_equal(result["length"], [1, 3, 7, 10])
    rl.evaluate(env, other, key(1), thetas + 1)
    assert evaluation._evaluate(env)._cache_size() == 1


def test_evaluation_uses_the_mean_action_unless_told_otherwise():
    env = probes.Clock()
    policy = rl.policy_of(rl.init(env, CONFIG, key(0)))
    thetas = jnp.array([[0.0], [2.0]])
    a, b = (rl.evaluate(env, policy, key(seed), thetas)["return"] for seed in (0, 1))
    np.testing.assert_array_equal(a, b)
    expected = sum(float(policy.act(None, jnp.array([t]))[0]) for t in (0.0, 1.0, 2.0, 3.0))
    np.testing.assert_allclose(a, [expected, expected + 8], atol=1e-5)
    c, d = (rl.evaluate(env, policy, key(seed), thetas, deterministic=False)["return"] for seed in (0, 1))
    assert (c != d).all()
    with pytest.raises(ValueError, match="parameters"):
        rl.evaluate(env, policy, key(0), jnp.zeros(2))


def test_policies_evaluated_together_return_what_each_returns_alone():
    env = probes.Clock()
    policies = [rl.policy_of(rl.init(env, CONFIG, key(seed))) for seed in (0, 1)]
    thetas = jnp.array([[[0.0], [2.0], [5.0]], [[1.0], [1.0], [3.0]]])
    both = rl.evaluate_together(env, policies, key(0), thetas)
    for i, policy in enumerate(policies):
        alone = rl.evaluate(env, policy, key(0), thetas[i])
        np.testing.assert_allclose(both["return"][i], alone["return"], rtol=1e-5)
        np.testing.assert_array_equal(both["length"][i], alone["length"])
    with pytest.raises(ValueError, match="2 policies"):
        rl.evaluate_together(env, policies, key(0), thetas[0])
