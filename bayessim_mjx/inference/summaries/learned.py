"""The summary that is the trajectory itself, for a network that learns its features (embedding.py)."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.inference.embedding import Embedding
from bayessim_mjx.inference.summaries.summary import Summary, affordable, at_steps, held, register


def summary_learned(states: Array, actions: Array, valid: Array | None = None) -> Array:
    """The trajectory itself for a network that learns its features (embedding.py) -> [(2 T + 1) S + T A + T].

    states, their changes s_{t+1} - s_t, actions, valid. Changes have a scale of their own, small beside the states'.
    """
    states, actions = held(states, actions, valid)
    mask = jnp.ones(actions.shape[0]) if valid is None else valid.astype(jnp.float32)
    parts = [states, states[1:] - states[:-1], actions, mask]
    affordable("summary_learned", sum(part.size for part in parts), "a shorter trajectory, corrdiff")
    return jnp.concatenate([part.reshape(-1) for part in parts])


def _names(steps: int, states: Sequence[str], actions: Sequence[str]) -> list[str]:
    changes = [f"change of {name}" for name in states]
    whole = at_steps(range(steps + 1), states), at_steps(range(steps), changes), at_steps(range(steps), actions)
    return [name for part in whole for name in part] + [f"whether step {t} ran" for t in range(steps)]


def _embedding(steps: int, states: int, actions: int) -> Embedding:
    return Embedding(steps, states, actions, window=min(Embedding.window, steps))


LEARNED = register(Summary("summary_learned", summary_learned, names=_names, embedding=_embedding))
