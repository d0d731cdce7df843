"""Probe environments: a few lines each, with values known beforehand; they implement the environment's protocol alone.

After rejax's and CleanRL's probes: each one can only be solved if one more part of the learner is right.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct


@struct.dataclass
class ProbeState:
    pipeline_state: Any
    obs: dict
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class NoParameters:
    """A parameter space without parameters."""

    nominal = np.zeros(0, np.float32)

    def __len__(self) -> int:
        return 0


class Probe:
    """Observation 0, reward 1, terminates after one step. Counts how often its step is traced."""

    action_size = 1
    episode_length = 10
    space = NoParameters()
    horizon = 1  # steps until termination; 0: never
    observation_size = {"policy": (1,)}

    def __init__(self) -> None:
        self.traces = 0

    def first(self, key: jax.Array) -> dict:
        return {"policy": jnp.zeros(1)}

    def next(self, obs: dict, steps: jax.Array) -> dict:
        return obs

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return jnp.ones(())

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> ProbeState:
        theta = jnp.asarray(self.space.nominal) if theta is None else theta
        obs, zero = self.first(key), jnp.zeros(())
        info = {"terminated": zero, "truncated": zero, "final_observation": obs, "steps": jnp.int32(0)}
        return ProbeState(theta, obs, zero, zero, {}, info)

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        self.traces += 1
        steps = state.info["steps"] + 1
        obs = self.next(state.obs, steps)
        terminated = (steps == self.horizon).astype(jnp.float32)
        truncated = (steps >= self.episode_length).astype(jnp.float32)
        info = {"terminated": terminated, "truncated": truncated, "final_observation": obs, "steps": steps}
        reward = self.reward(state.obs, action, steps)
        return state.replace(obs=obs, reward=reward, done=terminated, info={**state.info, **info})


class ConstantReward(Probe):
    """Value 1 everywhere: the critic regresses at all."""


class ObservationValue(Probe):
    """Observation +-1 at random and the same as reward: the critic sees its input, value = observation."""

    def first(self, key: jax.Array) -> dict:
        return {"policy": jax.random.rademacher(key, (1,), jnp.float32)}

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return obs["policy"][0]


class DelayedReward(Probe):
    """Two steps, reward 1 at the second: discounting, value(0) = gamma and value(1) = 1."""

    horizon = 2

    def next(self, obs: dict, steps: jax.Array) -> dict:
        return {"policy": steps[None].astype(jnp.float32)}

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return (steps == 2).astype(jnp.float32)


class ActionReward(Probe):
    """Reward -(a - 0.5)^2: the advantage reaches the actor, mean action 0.5."""

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return -((action[0] - 0.5) ** 2)


class ObservationAction(ObservationValue):
    """Reward -(a - obs / 2)^2: actions depend on observations, mean action +-0.5."""

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return -((action[0] - 0.5 * obs["policy"][0]) ** 2)


class TimeLimit(Probe):
    """Reward 1 for ever, cut every 5 steps by the time limit alone: value 1 / (1 - gamma), whatever the limit."""

    horizon = 0
    episode_length = 5


class Clock(Probe):
    """The observation is the time and the limit 4: the last observation of an episode is 4, never 0.

    The group "critic" sees time and theta; one parameter.
    """

    class space:
        nominal = np.zeros(1, np.float32)

    horizon = 0
    episode_length = 4
    observation_size = {"policy": (1,), "critic": (2,)}

    def first(self, key: jax.Array) -> dict:
        return {"policy": jnp.zeros(1), "critic": jnp.zeros(2)}

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> ProbeState:
        state = super().reset(key, theta)
        obs = {"policy": jnp.zeros(1), "critic": jnp.stack([jnp.zeros(()), state.pipeline_state[0]])}
        return state.replace(obs=obs, info={**state.info, "final_observation": obs})

    def next(self, obs: dict, steps: jax.Array) -> dict:
        time = steps.astype(jnp.float32)
        return {"policy": time[None], "critic": jnp.stack([time, obs["critic"][1]])}

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return action[0] + obs["critic"][1]


class Walk(Probe):
    """A random walk that the action pushes, with noise from its own key; ends at |x| > 3 or after 20 steps."""

    horizon = 0
    episode_length = 20

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> ProbeState:
        state = super().reset(key, theta)
        return state.replace(info={**state.info, "key": key})

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        after = super().step(state, action)
        key, noise = jax.random.split(state.info["key"])
        x = state.obs["policy"] + 0.5 * action + 0.3 * jax.random.normal(noise, (1,))
        terminated = (jnp.abs(x[0]) > 3).astype(jnp.float32)
        info = {**after.info, "key": key, "terminated": terminated, "final_observation": {"policy": x}}
        return after.replace(obs={"policy": x}, reward=1 - x[0] ** 2, done=terminated, info=info)


@struct.dataclass
class Domain:
    """Uniform in [low, high] for every parameter: a stand-in for a Distribution."""

    low: jax.Array
    high: jax.Array

    def sample(self, key: jax.Array, n: int) -> jax.Array:
        return jax.random.uniform(key, (n, *self.low.shape), minval=self.low, maxval=self.high)


class Lifetime(Probe):
    """theta is the number of steps until termination; reward 1 a step, so theta is also the return."""

    class space:
        nominal = np.ones(1, np.float32)

    horizon = 0

    def first(self, key: jax.Array) -> dict:
        return {"policy": jax.random.uniform(key, (1,))}

    def next(self, obs: dict, steps: jax.Array) -> dict:
        return {"policy": obs["policy"] + 1}

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        after = super().step(state, action)
        terminated = (after.info["steps"] >= state.pipeline_state[0]).astype(jnp.float32)
        return after.replace(done=terminated, info={**after.info, "terminated": terminated})


class Valley(Probe):
    """gym's MountainCarContinuous: 100 at the top, reached by swinging to and fro alone; each step costs 0.1 a^2.

    Observation: position, and speed in units of its range.
    """

    dt = 1.0
    power = 0.0015
    horizon, episode_length = 0, 200
    observation_size = {"policy": (2,)}

    def first(self, key: jax.Array) -> dict:
        return {"policy": jnp.stack([jax.random.uniform(key, minval=-0.6, maxval=-0.4), jnp.zeros(())])}

    def step(self, state: ProbeState, action: jax.Array) -> ProbeState:
        after = super().step(state, action)
        x, speed = state.obs["policy"] * jnp.array([1.0, 0.07])
        speed = jnp.clip(speed + self.power * jnp.clip(action[0], -1, 1) - 0.0025 * jnp.cos(3 * x), -0.07, 0.07)
        x = jnp.clip(x + speed, -1.2, 0.6)
        speed = jnp.where((x <= -1.2) & (speed < 0), 0.0, speed)
        top = (x >= 0.45).astype(jnp.float32)
        obs = {"policy": jnp.stack([x, speed / 0.07])}
        info = {**after.info, "terminated": top, "final_observation": obs}
        return after.replace(obs=obs, reward=100 * top - 0.1 * jnp.clip(action[0], -1, 1) ** 2, done=top, info=info)


class Broken(Probe):
    """A reward that is not a number."""

    def reward(self, obs: dict, action: jax.Array, steps: jax.Array) -> jax.Array:
        return jnp.float32(jnp.nan)
