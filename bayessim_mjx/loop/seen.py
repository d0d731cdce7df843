"""What a summary is made of, by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.inference import feature_names, summaries
from bayessim_mjx.rollout import Trajectory


def summarise(summarizer: Callable, trajectory: Trajectory) -> Array:
    """Features [worlds, D] of trajectories, from observations and actions while the episodes ran."""
    return jax.vmap(summarizer)(trajectory.observation, trajectory.action, trajectory.valid)


@dataclasses.dataclass(frozen=True)
class Seen:
    """What a summarizer is given, by name."""

    steps: int
    states: tuple[str, ...]
    actions: tuple[str, ...]
    context: tuple[str, ...] = ()  # features after those of the summary

    def features(self, summary: str) -> tuple[str, ...]:
        """A name for every feature."""
        return (*feature_names.names(summary, self.steps, self.states, self.actions), *self.context)

    def embedding(self, summary: str) -> Any:
        """The network that learns features from the summary's (inference/embedding.py); None: they are features."""
        learn = summaries.entry(summary)[0].embedding
        return None if learn is None else learn(self.steps, len(self.states), len(self.actions))


def named(names: Sequence[str], size: int, kind: str) -> tuple[str, ...]:
    """These names, or numbers where there are not as many as `size`."""
    return tuple(names) if len(names) == size else tuple(f"{kind} {i + 1}" for i in range(size))


def tiled(x: Array, count: int) -> Array:
    """`count` copies of x along a new first axis."""
    return jnp.broadcast_to(x, (count, *x.shape))
