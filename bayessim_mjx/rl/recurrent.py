"""Policies with a memory: GRU (Cho et al. 2014) or LSTM (Gers et al. 2000) layers before the actor's others.

The memory travels through the environment, as an observation group that the action carries on: it is zero wherever an
episode begins, and to all else a policy stays a function of its observations. The first numbers of a memory are the
units' outputs, which the next layer sees; an LSTM's cells follow them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

from bayessim_mjx.config.settings import MEMORIES
from bayessim_mjx.keys import branch

if TYPE_CHECKING:
    from bayessim_mjx.env import Env, State

Params = dict[str, Any]


@struct.dataclass
class Remembered:
    """One step: normalised observation [..., S] and the memory before it [..., M]."""

    observation: jax.Array
    memory: jax.Array


@struct.dataclass
class Sequences:
    """n sequences of T steps as they were collected; the memory counts only where `starts` is 1."""

    observation: jax.Array  # [n, T, S] normalised
    memory: jax.Array  # [n, T, M] before each step, of the collecting policy
    starts: jax.Array  # [n, T] 1 at the first step, wherever an episode begins, and where gradients are cut


def init(key: jax.Array, size: int, units: int, cell: str = "gru") -> Params:
    """Orthogonal weights of each gate, biases zero; an LSTM's forget gates begin at bias 1 (Jozefowicz et al. 2015)."""
    gates = CELLS[cell].gates
    keys = jax.random.split(key, 2 * gates)
    draw = jax.nn.initializers.orthogonal()
    side = lambda keys, n: jnp.concatenate([draw(k, (n, units)) for k in keys], -1)  # noqa: E731
    bias = jnp.zeros(gates * units)
    return {
        "x": {"w": side(keys[:gates], size), "b": bias.at[units : 2 * units].set(1.0) if cell == "lstm" else bias},
        "h": {"w": side(keys[gates:], units), "b": bias},
    }


def stacked(key: jax.Array, size: int, units: int, cell: str, count: int) -> dict[str, Params]:
    """Parameters of `count` layers of `units`, one on the other, by their keys in an actor: gru, gru_1 ..."""
    keys = [key, *(branch(key, i) for i in range(1, count))]
    return {_key(cell, i): init(k, units if i else size, units, cell) for i, k in enumerate(keys)}


def _key(cell: str, i: int) -> str:
    return f"{cell}_{i}" if i else cell


def gru(layer: Params, memory: jax.Array, x: jax.Array) -> jax.Array:
    """Compute the memory [..., H] after observations x [..., S]; gates in the order reset, update, candidate."""
    xr, xz, xn = jnp.split(x @ layer["x"]["w"] + layer["x"]["b"], 3, -1)
    hr, hz, hn = jnp.split(memory @ layer["h"]["w"] + layer["h"]["b"], 3, -1)
    reset, update = jax.nn.sigmoid(xr + hr), jax.nn.sigmoid(xz + hz)
    # h' = (1 - z) tanh(x_n + r h_n) + z h
    return (1 - update) * jnp.tanh(xn + reset * hn) + update * memory


def lstm(layer: Params, memory: jax.Array, x: jax.Array) -> jax.Array:
    """Compute the memory [..., 2 H] = (h, c) after x [..., S]; gates: input, forget, candidate, output."""
    hidden, cells = jnp.split(memory, 2, -1)
    sums = x @ layer["x"]["w"] + layer["x"]["b"] + hidden @ layer["h"]["w"] + layer["h"]["b"]
    take, keep, new, show = jnp.split(sums, 4, -1)
    # c' = sigma(f) c + sigma(i) tanh(g),  h' = sigma(o) tanh(c')
    cells = jax.nn.sigmoid(keep) * cells + jax.nn.sigmoid(take) * jnp.tanh(new)
    return jnp.concatenate([jax.nn.sigmoid(show) * jnp.tanh(cells), cells], -1)


@dataclass(frozen=True)
class Cell:
    """A kind of recurrent layer."""

    gates: int
    after: Callable[[Params, jax.Array, jax.Array], jax.Array]  # (layer, memory, x) -> memory


CELLS = {"gru": Cell(3, gru), "lstm": Cell(4, lstm)}


def kind(actor: Params) -> str | None:
    """Name its recurrent layer, which is the key of its parameters; None without one."""
    return next((name for name in CELLS if name in actor), None)


def layers(actor: Params) -> list[Params]:
    """Its recurrent layers, from the first to the last."""
    name = kind(actor)
    if name is None:
        return []
    keys = [_key(name, i) for i in range(len(actor))]
    return [actor[key] for key in keys if key in actor]


def units(actor: Params) -> int:
    """Count outputs of a recurrent layer, 0 without one."""
    name = kind(actor)
    return 0 if name is None else len(actor[name]["h"]["w"])


def memory_size(actor: Params) -> int:
    """Numbers of memory, 0 without one."""
    name = kind(actor)
    return 0 if name is None else MEMORIES[name] * units(actor) * len(layers(actor))


def memories(actor: Params, x: Remembered | Sequences) -> jax.Array:
    """Compute the memory after each observation, [..., M]."""
    name = kind(actor)
    assert name is not None
    stack, cell, outputs = layers(actor), CELLS[name], units(actor)

    def after(memory: jax.Array, seen: jax.Array) -> jax.Array:
        parts = []
        for layer, part in zip(stack, jnp.split(memory, len(stack), -1), strict=True):
            parts.append(cell.after(layer, part, seen))
            seen = parts[-1][..., :outputs]
        return jnp.concatenate(parts, -1)

    if isinstance(x, Remembered):
        return after(x.memory, x.observation)

    def step(memory: jax.Array, now: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        observation, stored, start = now
        memory = after(jnp.where(start[:, None] > 0, stored, memory), observation)
        return memory, memory

    in_time = jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), (x.observation, x.memory, x.starts))
    return jax.lax.scan(step, x.memory[:, 0], in_time)[1].swapaxes(0, 1)


def features(actor: Params, x: Remembered | Sequences) -> jax.Array:
    """Compute the last layer's outputs after each observation, [..., H]: the input of the actor's other layers."""
    whole, last = memories(actor, x), memory_size(actor) - memory_size(actor) // len(layers(actor))
    return whole[..., last : last + units(actor)]


def sequences(x: Remembered, ended: jax.Array, length: int = 0) -> Sequences:
    """Time-major steps [T, N, ...], of which `ended` [T, N] were the last of an episode; still time-major.

    length: gradients flow back through so many steps at most, and on the first of them the memory is the collecting
    policy's; 0: through all of them.
    """
    starts = jnp.concatenate([jnp.ones_like(ended[:1]), ended[:-1]])
    if length:
        cut = jnp.arange(len(starts)) % length == 0
        starts = jnp.maximum(starts, cut[:, None].astype(starts.dtype))
    return Sequences(x.observation, x.memory, starts)


@lru_cache(maxsize=32)
def remembering(env: Env, numbers: int) -> Any:
    """`env` for a policy with `numbers` of memory (`ppo.memory_size`); the same object for the same arguments."""
    return Remembering(env, numbers)


class Remembering:
    """An environment whose actions end with the policy's memory, shown to it at the next step as the group "memory"."""

    def __init__(self, env: Env, numbers: int) -> None:
        self.env, self.memory_size = env, numbers
        self.action_size = env.action_size + numbers
        self.observation_size = {**env.observation_size, "memory": (numbers,)}

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.env, name)
        # of an action with or without a memory behind it
        return (lambda action: value(action[: self.env.action_size])) if name == "command" else value

    def reset(self, key: jax.Array, theta: jax.Array | None = None, *course: Any) -> State:
        return self._show(self.env.reset(key, theta, *course), jnp.zeros(self.memory_size))

    def step(self, state: State, action: jax.Array) -> State:
        action, memory = jnp.split(action, [self.env.action_size])
        return self._show(self.env.step(state, action), memory)

    def _show(self, state: State, memory: jax.Array) -> State:
        seen = {**state.info["final_observation"], "memory": memory}
        return state.replace(obs={**state.obs, "memory": memory}, info={**state.info, "final_observation": seen})
