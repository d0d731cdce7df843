"""Policies with a memory: a gated recurrent unit (Cho et al. 2014) before the actor's layers.

The memory travels through the environment, as an observation group that the action carries on: it is zero wherever an
episode begins, and to all else a policy stays a function of its observations.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State

Params = dict[str, Any]


@struct.dataclass
class Remembered:
    """One step: normalised observation [..., S] and the memory before it [..., H]."""

    observation: jax.Array
    memory: jax.Array


@struct.dataclass
class Sequences:
    """n sequences of T steps as they were collected; the memory counts only where `starts` is 1."""

    observation: jax.Array  # [n, T, S] normalised
    memory: jax.Array  # [n, T, H] before each step, of the collecting policy
    starts: jax.Array  # [n, T] 1 at the first step and wherever an episode begins


def init(key: jax.Array, size: int, units: int) -> Params:
    """Orthogonal weights of the three gates (reset, update, candidate), biases zero."""
    keys = jax.random.split(key, 6)
    draw = jax.nn.initializers.orthogonal()
    gates = lambda keys, n: jnp.concatenate([draw(k, (n, units)) for k in keys], -1)  # noqa: E731
    return {
        "x": {"w": gates(keys[:3], size), "b": jnp.zeros(3 * units)},
        "h": {"w": gates(keys[3:], units), "b": jnp.zeros(3 * units)},
    }


def cell(gru: Params, memory: jax.Array, x: jax.Array) -> jax.Array:
    """The memory [..., H] after observations x [..., S]."""
    xr, xz, xn = jnp.split(x @ gru["x"]["w"] + gru["x"]["b"], 3, -1)
    hr, hz, hn = jnp.split(memory @ gru["h"]["w"] + gru["h"]["b"], 3, -1)
    reset, update = jax.nn.sigmoid(xr + hr), jax.nn.sigmoid(xz + hz)
    # h' = (1 - z) tanh(x_n + r h_n) + z h
    return (1 - update) * jnp.tanh(xn + reset * hn) + update * memory


def features(gru: Params, x: Remembered | Sequences) -> jax.Array:
    """Memories after each observation, [..., H]: what the actor's layers see."""
    if isinstance(x, Remembered):
        return cell(gru, x.memory, x.observation)

    def step(memory: jax.Array, now: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        observation, stored, start = now
        memory = cell(gru, jnp.where(start[:, None] > 0, stored, memory), observation)
        return memory, memory

    in_time = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), (x.observation, x.memory, x.starts))
    return jax.lax.scan(step, x.memory[:, 0], in_time)[1].swapaxes(0, 1)


def sequences(x: Remembered, ended: jax.Array) -> Sequences:
    """Time-major steps [T, N, ...], of which `ended` [T, N] were the last of an episode; still time-major."""
    return Sequences(x.observation, x.memory, jnp.concatenate([jnp.ones_like(ended[:1]), ended[:-1]]))


@lru_cache(maxsize=32)
def remembering(env: Env, units: int) -> Any:
    """`env` for a policy with `units` of memory; the same object for the same arguments."""
    return Remembering(env, units)


class Remembering:
    """An environment whose actions end with the policy's memory, shown to it at the next step as the group "memory"."""

    def __init__(self, env: Env, units: int) -> None:
        self.env, self.memory_size = env, units
        self.action_size = env.action_size + units
        self.observation_size = {**env.observation_size, "memory": (units,)}

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.env, name)
        # of an action with or without a memory behind it
        return (lambda action: value(action[: self.env.action_size])) if name == "command" else value

    def reset(self, key: jax.Array, theta: jax.Array | None = None) -> State:
        return self._show(self.env.reset(key, theta), jnp.zeros(self.memory_size))

    def step(self, state: State, action: jax.Array) -> State:
        action, memory = jnp.split(action, [self.env.action_size])
        return self._show(self.env.step(state, action), memory)

    def _show(self, state: State, memory: jax.Array) -> State:
        seen = {**state.info["final_observation"], "memory": memory}
        return state.replace(obs={**state.obs, "memory": memory}, info={**state.info, "final_observation": seen})
