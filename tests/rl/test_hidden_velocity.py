"""A swinging mass whose velocity is not shown: only a policy that remembers where it was can bring it to rest."""

import dataclasses

import jax
import jax.numpy as jnp
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import recurrent
from tests.rl import probes

DT = 0.4  # s, of a period of 2 pi

CONFIG = PPOConfig(
    num_envs=64, num_steps=25, num_epochs=4, num_minibatches=4, learning_rate=3e-3, schedule="fixed", gamma=0.95,
    hidden_actor=(16,), hidden_critic=(32, 32), init_std=0.5, max_iterations=60, log_interval=60,
)  # fmt: skip


class Swing(probes.Probe):
    """x'' = -x + u, |u| <= 1, from amplitude 1 at a random phase; reward -(x^2 + v^2), twice its energy.

    The policy sees x, the critic both. A force that depends on x alone is conservative: it can take no energy out.
    """

    horizon = 0
    episode_length = 50
    observation_size = {"policy": (1,), "critic": (2,)}

    def first(self, key):
        phase = jax.random.uniform(key, maxval=2 * jnp.pi)
        return self.shown(jnp.stack([jnp.cos(phase), jnp.sin(phase)]))

    def shown(self, motion):
        return {"policy": motion[:1], "critic": motion}

    def step(self, state, action):
        x, v = state.info["final_observation"]["critic"]
        v = v + DT * (jnp.clip(action[0], -1, 1) - x)
        motion = jnp.stack([x + DT * v, v])
        after, seen = super().step(state, action), self.shown(motion)
        info = {**after.info, "final_observation": seen}
        return after.replace(obs=seen, reward=-(motion**2).sum(), info=info)


# not in CI: what a memory learns is test_recurrent.py::test_what_was_seen_before_is_remembered[lstm]
@pytest.mark.slow
@pytest.mark.parametrize("cell", [None, "gru", "lstm"])
def test_only_a_memory_brings_the_mass_to_rest(cell):
    """Mean x^2 + v^2 is 1 where nothing is done; the critic sees all, so what is missing without a memory is memory."""
    config = CONFIG if cell is None else dataclasses.replace(CONFIG, memory=8, memory_cell=cell)
    env = Swing() if cell is None else recurrent.remembering(Swing(), config.memory_size)
    policy, _ = rl.train(env, config, jax.random.PRNGKey(0))
    result = rl.evaluate(env, policy, jax.random.PRNGKey(1), jnp.zeros((64, 0)))
    energy = -result["return"].mean() / env.episode_length
    assert energy > 0.9 if cell is None else energy < 0.1
