"""A counter as an environment, and a picture of it: all of it can be computed by hand."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Env, State
from bayessim_mjx.mirrors import MirrorMap
from bayessim_mjx.parameters import Parameter, ParameterSpace


class Counter(Env):
    """Observation [steps, start, theta]; ends for good after `theta` steps, by time after 5; reward 1 + the action."""

    name, episode_length, action_size, dt = "Counter", 5, 1, 0.1
    mj_model = mujoco.MjModel.from_xml_string("<mujoco/>")
    space = ParameterSpace((Parameter("life", nominal=9.0, low=1.0, high=9.0),))

    def reset(self, key, theta=None):
        life = jnp.asarray(self.space.nominal if theta is None else theta, jnp.float32)[0]
        start = jax.random.uniform(key)
        zero, no = jnp.zeros(()), jnp.zeros(())
        return self._state(jnp.stack([zero, start, life]), no, no, no, jnp.int32(0))

    def step(self, state, action):
        obs = state.obs["policy"].at[0].add(1)
        steps = state.info["steps"] + 1
        terminated = (obs[0] >= obs[2]).astype(jnp.float32)
        truncated = (steps >= self.episode_length).astype(jnp.float32)
        after = self._state(obs, 1 + action[0], terminated, truncated, steps)
        return after.replace(info={**state.info, **after.info})

    def _state(self, obs, reward, terminated, truncated, steps):
        groups = {"policy": obs, "critic": jnp.concatenate([obs, obs])}
        info = {"terminated": terminated, "truncated": truncated, "final_observation": groups, "steps": steps}
        return State(obs, groups, reward, terminated, {"age": obs[0]}, info)


class Camera(Counter):
    """The counter as a picture: "policy" is `[36, 36, 1]` bytes, 40 times the steps; "numbers" is the counter's own."""

    name = "Camera"

    def reset(self, key, theta=None):
        return self._filmed(super().reset(key, theta))

    def step(self, state, action):
        return self._filmed(super().step(state.replace(obs={"policy": state.obs["numbers"]}), action))

    def _filmed(self, state):
        picture = jnp.full((36, 36, 1), 40 * state.obs["policy"][0]).astype(jnp.uint8)
        groups = {"policy": picture, "numbers": state.obs["policy"]}
        return state.replace(obs=groups, info={**state.info, "final_observation": groups})


class Plain(Counter):
    """The counter without observations of the critic's own."""

    def _state(self, obs, reward, terminated, truncated, steps):
        state = super()._state(obs, reward, terminated, truncated, steps)
        seen = {"policy": obs}
        return state.replace(obs=seen, info={**state.info, "final_observation": seen})


class Mirrored(Counter):
    """The counter with a mirror image: all its numbers with the other sign."""

    name = "Mirrored"
    mirrors = (
        MirrorMap(
            observation={"policy": (np.arange(3), -np.ones(3)), "critic": (np.arange(6), -np.ones(6))},
            action=(np.arange(1), -np.ones(1)),
        ),
    )
