"""Kinds of policies by configuration: each learns a probe, and what cannot work is refused."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=64, num_steps=8, num_epochs=4, num_minibatches=4, learning_rate=3e-3, schedule="adaptive", gamma=0.9,
    hidden_actor=(16,), hidden_critic=(16,), use_clipped_value_loss=False, max_iterations=60, log_interval=60,
)  # fmt: skip
KINDS = [
    {"action_bound": "tanh", "entropy_coef": 1e-3, "shared_trunk": True},
    {"action_bound": "tanh", "state_dependent_std": True},
]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_policy_learns_actions_that_follow_the_observation(kind):
    env, config = probes.ObservationAction(), dataclasses.replace(CONFIG, **kind)
    policy, metrics = rl.train(env, config, jax.random.PRNGKey(0))
    actions = policy.act(None, jnp.array([[-1.0], [1.0]]))[:, 0]
    np.testing.assert_allclose(actions, [-0.5, 0.5], atol=0.08)
    assert metrics["Policy/mean_std"] < 0.5


def test_the_first_minibatch_sees_an_unchanged_policy():
    """Old and new distributions agree before the first step, also where they differ by state: KL 0, every ratio 1."""
    config = dataclasses.replace(CONFIG, num_epochs=1, num_minibatches=1, **KINDS[1])
    env = probes.Walk()
    _, metrics = rl.make_update(env, config)(rl.init(env, config, jax.random.PRNGKey(0)), None)
    assert metrics["Loss/kl"] < 1e-9
    assert metrics["Loss/clip_fraction"] == 0


@pytest.mark.slow
@pytest.mark.ci
def test_a_spread_that_depends_on_the_state_learns_where_to_be_narrow():
    """Reward -(a - 0.5)^2 weighs 1 at observation 1 and nothing at -1."""

    class Careful(probes.ObservationValue):
        def reward(self, obs, action, steps):
            return -(obs["policy"][0] + 1) * (action[0] - 0.5) ** 2

    config = dataclasses.replace(CONFIG, state_dependent_std=True, entropy_coef=1e-3)
    policy, _ = rl.train(Careful(), config, jax.random.PRNGKey(0))
    _, log_std = policy.distribution(jnp.array([[-1.0], [1.0]]))
    assert log_std[1, 0] < log_std[0, 0] - 0.5


def test_what_cannot_work_is_refused():
    with pytest.raises(UserError, match=r"ppo.action_bound = 'beta': allowed are clip, tanh"):
        PPOConfig(action_bound="beta")
    with pytest.raises(UserError, match=r"ppo.hidden_actor is \[\]"):
        PPOConfig(shared_trunk=True, hidden_actor=())
    with pytest.raises(UserError, match=r"ppo.init_std = 0.001.*from 0.007"):
        PPOConfig(state_dependent_std=True, init_std=0.001)
    with pytest.raises(UserError, match=r"ppo.shared_trunk = True: Clock"):
        rl.init(probes.Clock(), dataclasses.replace(CONFIG, shared_trunk=True), jax.random.PRNGKey(0))
