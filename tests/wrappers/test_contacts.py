"""Warp's contacts have room for as many worlds as step together, whoever makes them step; none is left out silently."""

import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Task
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summarizers
from bayessim_mjx.loop import trajectories
from bayessim_mjx.loop.sources import Surrogate
from bayessim_mjx.physics.warp import OVERFLOW, refuse_overflow
from bayessim_mjx.wrappers.gymnasium import GymnasiumVectorEnv
from bayessim_mjx.wrappers.worlds import Worlds

WORLDS = 300  # more than `LEAST_WORLDS`: with two contacts each they fill the room of 256 and more
XML = """
<mujoco model="balls"><option timestep="0.002"/><worldbody>
  <geom type="plane" size="5 5 1"/>
  <body name="left" pos="0 0 0.099"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1" mass="2"/></body>
  <body pos="1 0 0.099"><joint type="slide" axis="0 0 1"/><geom type="sphere" size="0.1" mass="2"/></body>
</worldbody><actuator><motor joint="left" gear="1"/></actuator></mujoco>
"""
XML = XML.replace('<joint type="slide" axis="0 0 1"/>', '<joint name="left" type="slide" axis="0 0 1"/>', 1)
ROOM_FOR_ONE = '<custom><numeric name="max_contact_points" data="1"/></custom><option'
MASS = {"mass": {"range": [0.5, 2.0], "operation": "scaling", "distribution": "uniform"}}


class Balls(Task):
    """Two balls lie on the ground and stay there; the reward is 1, and the observation how high they are."""

    control_dt, default_episode_length = 0.002, 4
    observation_names = ("left", "right")
    randomization = {"randomization_params": {"actor_params": {"balls": {"rigid_body_properties": MASS}}}}
    xml = XML

    def spec(self):
        return mujoco.MjSpec.from_string(self.xml)

    def initial(self, key):
        return jnp.zeros(2), jnp.zeros(2)

    def command(self, action):
        return 0.0 * action

    def observe(self, world, data, action):
        return {"policy": world.measurement["qpos"]}

    def reward(self, before, after, data, action):
        return jnp.float32(1.0), jnp.zeros((), bool), {"height": after.qpos[0]}


class Crowd(Balls):
    """The same, but the model has room for one contact in place of two."""

    xml = XML.replace("<option", ROOM_FOR_ONE)


def in_worlds(env):
    worlds = Worlds(env, num_envs=WORLDS)
    worlds.reset()
    counted = [worlds.step(jnp.zeros((WORLDS, 1))).metrics[OVERFLOW] for _ in range(3)]
    return 1.0 + float(np.max(counted))


def in_gymnasium(env):
    vector = GymnasiumVectorEnv(env, WORLDS)
    vector.reset(seed=0)
    return float(vector.step(np.zeros((WORLDS, 1), np.float32))[1].mean())


def policy(env):
    config = PPOConfig(num_envs=WORLDS, hidden_actor=[4], hidden_critic=[4])
    return rl.policy_of(rl.init(env, config, jax.random.PRNGKey(0)))


def evaluated(env):
    """`ppo.eval_episodes` and `play --episodes`: the mean return of a step."""
    thetas = jnp.ones((WORLDS, len(env.space)))
    return float(rl.evaluate(env, policy(env), jax.random.PRNGKey(0), thetas)["return"].mean()) / env.episode_length


def collected(env):
    """The loop's training set, in one chunk: 1 where all are numbers."""
    nominal = env.space.nominal
    one = np.ones(1), nominal[None], 0 * nominal[None]
    source = Surrogate(env, env.space, *one, "policy_random", 3, 0.0, summarizers.get("start"))
    prior = Distribution.prior(env.space, 1)
    _, x, _ = trajectories.simulated(source, jax.random.PRNGKey(0), policy(env), prior.sample, WORLDS)
    return float(np.isfinite(x).all())


def trained(env):
    config = PPOConfig(num_envs=WORLDS, num_steps=4, num_minibatches=1, num_epochs=1, hidden_actor=[4])
    _, metrics = rl.train(env, config, jax.random.PRNGKey(0), iterations=2)
    assert metrics[f"Train/{OVERFLOW}"] == 0.0
    return metrics["Train/mean_reward"] / env.episode_length


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.skipif(importlib.util.find_spec("warp") is None, reason="warp-lang is not installed")
@pytest.mark.parametrize("stepped", [in_worlds, in_gymnasium, evaluated, collected, trained])
def test_all_worlds_have_room_and_an_overflow_is_an_error(stepped):
    """Each takes the reward 1 in each step; where contacts have no room, nobody gets numbers."""
    assert stepped(Balls({"impl": "warp"})) == pytest.approx(1.0)
    with pytest.raises(UserError, match="env.impl = 'warp': contacts had no room in 1 of "):
        stepped(Crowd({"impl": "warp"}))


def test_an_overflow_is_told_with_its_share():
    refuse_overflow(np.float32(0.0), "the steps")
    with pytest.raises(UserError, match=r"no room in 0.25 of the steps.*env.impl to jax.*max_contact_points"):
        refuse_overflow(np.float32(0.25), "the steps")
