"""A pendulum paid only while it stands: PPO alone learns to hang still; with a reward for novelty it swings up."""

import argparse
from dataclasses import replace

import jax
import jax.numpy as jnp

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig, RNDConfig, WeightSchedule
from bayessim_mjx.tasks.pendulum import Pendulum


class Standing(Pendulum):
    """Hangs at the start; reward 1 a step within 0.3 rad of upright, and always -0.1 a^2."""

    def initial(self, key):
        return jnp.pi + jax.random.uniform(key, (1,), minval=-0.1, maxval=0.1), jnp.zeros(1)

    def reward(self, before, after, data, action):
        upright = (jnp.cos(after.qpos[0]) > jnp.cos(0.3)).astype(jnp.float32)
        return upright - 0.1 * action[0] ** 2, jnp.zeros((), bool), {"upright": upright}


NOVELTY = RNDConfig(
    num_outputs=16,
    predictor_hidden_dims=(64, 64),
    target_hidden_dims=(64, 64),
    state_normalization=True,
    reward_normalization=True,
    weight=200.0,
    weight_schedule=WeightSchedule("linear", initial_step=2500, final_step=5000, final_value=0.0),
    learning_rate=1e-4,
)
alone = PPOConfig(num_envs=128, num_steps=50, num_minibatches=8, learning_rate=1e-3, gamma=0.98, log_interval=25)
parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--iterations", type=int, default=200, help="of PPO, for each of the two (default: 200)")
alone = replace(alone, max_iterations=parser.parse_args().iterations)
env = Standing({}, randomization={"randomize": False})
for name, config in {"PPO alone": alone, "with novelty": replace(alone, rnd=NOVELTY)}.items():

    def show(metrics, state, name=name):
        novelty = metrics.get("Rnd/mean_intrinsic_reward", 0.0)
        print(f"{name}, iteration {int(state.iteration)}: {metrics['Train/mean_reward']:.1f} novelty {novelty:.1f}")

    policy, _ = rl.train(env, config, jax.random.PRNGKey(0), progress=show)
    returns = rl.evaluate(env, policy, jax.random.PRNGKey(1), jnp.zeros((64, 0)))["return"]
    print(f"{name}: return {returns.mean():.1f} of 200 steps")
