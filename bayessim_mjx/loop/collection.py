"""Collection of trajectories: the policy that acts, and the named inputs of a summarizer."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.compat import brief
from bayessim_mjx.inference import summaries
from bayessim_mjx.inference.numbers import DEFENSIVE
from bayessim_mjx.inference.summarizers import feature_names
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory

RANDOM_SHARE = DEFENSIVE  # policy_rl_randomized: share of the steps with a uniformly random action; source: BayesSimIG
POLICY_DEPENDENT = ("policy_rl", "policy_rl_randomized")


def policy_function(name: str, policy: Policy, action_size: int, memory: int = 0) -> Callable[[Array, dict], Array]:
    """Return the collection policy `name` as a function (key, obs of one world) -> action [action_size].

    memory: numbers at the end of an action that are the policy's memory (`rl.recurrent`), 0 where it is not asked.
    random is symmetric, U[-1, 1]; rl_randomized flips its coin for every world and step by itself. The policy's arrays
    are leaves of the function, so a new policy does not recompile.
    """
    if name == "policy_rl":
        return jax.tree_util.Partial(_act, policy)
    if name == "policy_rl_randomized":
        return jax.tree_util.Partial(_randomized(memory), policy)
    return {"policy_random": _random, "policy_ones": _ones}[name](action_size - memory, memory)


def _act(policy: Policy, key: Array, obs: dict) -> Array:
    return dataclasses.replace(policy, deterministic=False).act(key, obs)


@functools.lru_cache  # the same function again, which does not recompile
def _randomized(memory: int) -> Callable[[Policy, Array, dict], Array]:
    def act(policy: Policy, key: Array, obs: dict) -> Array:
        k_coin, k_random, k_policy = jax.random.split(key, 3)
        action = _act(policy, k_policy, obs)
        acted, remembered = jnp.split(action, [action.shape[-1] - memory])
        other = jax.random.uniform(k_random, acted.shape, minval=-1.0, maxval=1.0)
        return jnp.concatenate([jnp.where(jax.random.bernoulli(k_coin, RANDOM_SHARE), other, acted), remembered])

    return act


@functools.lru_cache
def _random(actions: int, memory: int) -> Callable[[Array, dict], Array]:
    return lambda key, obs: jnp.pad(jax.random.uniform(key, (actions,), minval=-1.0, maxval=1.0), (0, memory))


@functools.lru_cache
def _ones(actions: int, memory: int) -> Callable[[Array, dict], Array]:
    return lambda key, obs: jnp.pad(jnp.ones(actions), (0, memory))


@functools.partial(brief, static_argnums=0)
def summarise(summarizer: Callable, trajectory: Trajectory) -> Array:
    """Features [worlds, D] of trajectories, from observations and actions while the episodes ran."""
    return jax.vmap(summarizer)(trajectory.observation, trajectory.action, trajectory.valid)


@dataclasses.dataclass(frozen=True)
class SummaryInputs:
    """Named inputs of a summarizer."""

    steps: int
    states: tuple[str, ...]
    actions: tuple[str, ...]
    context: tuple[str, ...] = ()  # features after those of the summary

    def features(self, summary: str) -> tuple[str, ...]:
        """Name every feature."""
        return (*feature_names(summary, self.steps, self.states, self.actions), *self.context)

    def embedding(self, summary: str) -> Any:
        """Make the network that learns features from the summary (summaries/learned.py); None: the summary has them."""
        learn = summaries.entry(summary)[0].embedding
        return None if learn is None else learn(self.steps, len(self.states), len(self.actions))


def named(names: Sequence[str], size: int, kind: str) -> tuple[str, ...]:
    """Return these names, or numbers where there are not as many as `size`."""
    return tuple(names) if len(names) == size else tuple(f"{kind} {i + 1}" for i in range(size))


def tiled(x: Array, count: int) -> Array:
    """`count` copies of x along a new first axis."""
    return jnp.broadcast_to(x, (count, *x.shape))
