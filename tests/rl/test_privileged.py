"""The critic that sees theta: what it sees, that the actor does not, and what it gains."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.rl import networks, normalise, privileged
from tests.rl import probes

CONFIG = PPOConfig(
    num_envs=64, num_steps=8, num_epochs=4, num_minibatches=4, learning_rate=3e-3, schedule="fixed", gamma=0.9,
    hidden_actor=(16,), hidden_critic=(16,), use_clipped_value_loss=False, max_iterations=60, log_interval=60,
    critic_theta=True,
)  # fmt: skip


class Luck(probes.Probe):
    """The reward is theta, from 2 to 6, and nothing else tells it."""

    class space(probes.NoParameters):
        nominal, low, high = (np.array([x], np.float32) for x in (4, 2, 6))

        def __len__(self) -> int:
            return 1

    space = space()

    def step(self, state, action):
        return super().step(state, action).replace(reward=state.pipeline_state[0])


DOMAIN = probes.Domain(jnp.array([2.0]), jnp.array([6.0]))


def test_theta_follows_the_observation_within_minus_one_and_one():
    env = privileged.for_critic(Luck())
    state = env.reset(jax.random.PRNGKey(0), jnp.array([5.0]))
    np.testing.assert_array_equal(state.obs["critic"], [0.0, 0.5])
    np.testing.assert_array_equal(state.obs["policy"], [0.0])
    after = env.step(state, jnp.zeros(1))
    np.testing.assert_array_equal(after.obs["critic"], [0.0, 0.5])
    np.testing.assert_array_equal(after.info["final_observation"]["critic"], [0.0, 0.5])
    np.testing.assert_array_equal(env.reset(jax.random.PRNGKey(0)).obs["critic"], [0.0, 0.0])  # nominal
    assert env.observation_size == {"policy": (1,), "critic": (2,)}
    assert (env.action_size, env.episode_length) == (1, 10)


def known_by(low, high, names=("mass", "length")):
    """A walk of two parameters, with these ranges."""
    env = probes.Walk()
    env.space = ParameterSpace([Parameter(*row) for row in zip(names, (1.0, 1.0), low, high, strict=True)])
    return env


def shown(env, policy, theta):
    state = env.step(env.reset(jax.random.PRNGKey(0), jnp.array(theta)), jnp.zeros(1))
    return state.obs[policy][-2:]


@pytest.mark.parametrize(("made", "group"), [(privileged.for_teacher, "teacher"), (privileged.for_policy, "policy")])
def test_a_policy_sees_theta_as_it_has_learnt_to(made, group):
    """A mass of 1.5 kg on the way from 0.01 to 2 kg is (1.5 - 1.005) / 0.995; parameters are found by their names."""
    here, theirs = known_by((0.5, 0.1), (1.5, 2.1)), known_by((0.01, 0.0), (2.0, 4.0)).space
    own, its = [0.5 / 0.5, -0.6 / 1.0], [0.495 / 0.995, -1.5 / 2.0]
    np.testing.assert_allclose(shown(made(here), group, [1.5, 0.5]), own, rtol=1e-6)
    np.testing.assert_allclose(shown(made(here, theirs), group, [1.5, 0.5]), its, rtol=1e-6)
    turned = theirs.subset(("length", "mass"))
    np.testing.assert_allclose(shown(made(here, turned), group, [1.5, 0.5]), its[::-1], rtol=1e-6)
    with pytest.raises(UserError, match="to see the parameters mass, gear, but here mass, length are randomised"):
        made(here, known_by((0, 0), (2, 2), ("mass", "gear")).space)


def test_the_value_follows_theta_and_the_policy_does_not_see_it():
    """Value = theta; a critic without theta could explain nothing of it."""
    env = Luck()
    state, metrics = rl.run(env, CONFIG, rl.init(env, CONFIG, jax.random.PRNGKey(0), DOMAIN), DOMAIN)
    assert metrics["Loss/explained_variance"] > 0.9
    seen = normalise.normalise(state.normalizer["critic"], jnp.array([[0.0, -0.5], [0.0, 0.5]]))
    np.testing.assert_allclose(networks.value(state.params, seen, jax.nn.elu), [3.0, 5.0], atol=0.15)
    assert rl.policy_of(state).actor["layers"][0]["w"].shape == (1, 16)
    result = rl.evaluate(env, rl.policy_of(state), jax.random.PRNGKey(0), jnp.array([[2.0], [6.0]]))
    np.testing.assert_array_equal(result["return"], [2, 6])


def test_what_cannot_work_is_refused():
    with pytest.raises(UserError, match="ppo.critic_theta: there are no parameters"):
        rl.init(probes.Walk(), CONFIG, jax.random.PRNGKey(0))
    with pytest.raises(UserError, match="ppo.critic_theta = True: with ppo.shared_trunk"):
        dataclasses.replace(CONFIG, shared_trunk=True)
