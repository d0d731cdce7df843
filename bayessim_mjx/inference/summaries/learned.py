"""The summary that is the trajectory itself, and the network that learns features from it: deep set or convolution.

Contract of an embedding with the fit (all pure, jit-able and vmappable; shapes static; no state but `params`):
    embedding = Embedding(steps=T, state_size=S, action_size=A)    frozen and hashable: a static field of settings
    rows [B, D]                              rows of summary_learned, D = embedding.row_size; columns after that
                                             (context, say a first state) reach the features as they are
    mean, rate = embedding.scales(rows, ok)  in place of the standardisation by column: one scale per channel, and
                                             none for `valid`, which must stay 0 and 1
    params = Embedding.init(key, rows)       a pytree, all of it to be trained; of rows only the shape is used
    Embedding.apply(params, rows) -> [B, F]  features of standardised rows, of order 1: not to be standardised again;
                                             F = embedding.size(D) is the density network's input
The gradient of the density network's loss goes through `apply`; ensembles vmap over keys and params.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jax import Array

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.summaries.summary import Summary, affordable, at_steps, held, register
from bayessim_mjx.linalg import inverse_spread


class _Network(nn.Module):
    """Convolutions over time, mean and spread over the steps that the episode ran, one dense layer."""

    width: int
    window: int
    features: int

    @nn.compact
    def __call__(self, x: Array, valid: Array) -> Array:
        mask = valid[..., None]
        for _ in range(2):
            # a convolution as one matrix product: much faster than nn.Conv under vmap over params
            x = nn.silu(nn.Dense(self.width)(_windows(x, self.window))) * mask  # nothing leaks from after the end
        count = jnp.maximum(jnp.sum(mask, axis=-2), 1.0)
        mean = jnp.sum(x, axis=-2) / count
        spread = jnp.sqrt(jnp.sum(mask * (x - mean[..., None, :]) ** 2, axis=-2) / count + 1e-6)
        share = jnp.sum(mask, axis=-2) / mask.shape[-2]
        pooled = jnp.concatenate([mean, spread, share], axis=-1)
        pooled = nn.silu(nn.Dense(2 * self.features)(pooled))
        return nn.Dense(self.features)(pooled)


def _windows(x: Array, window: int) -> Array:
    """Join the `window` rows around each row of x [..., T, C], zeros beyond the ends -> [..., T, window C]."""
    steps, before = x.shape[-2], (window - 1) // 2
    x = jnp.pad(x, [(0, 0)] * (x.ndim - 2) + [(before, window - 1 - before), (0, 0)])
    return jnp.concatenate([x[..., i : i + steps, :] for i in range(window)], axis=-1)


@dataclass(frozen=True)
class Embedding:
    """[(t, s_t, a_t, s_{t+1} - s_t)] -> features; `window` steps are seen together.

    window = 1 is a deep set of transitions: right where each one is measured without noise. More steps average noise.
    """

    steps: int  # T
    state_size: int  # S
    action_size: int  # A
    features: int = 32  # learned features F, without context
    width: int = 0  # channels of the two convolutions; 0: as many as the dense layer has units
    window: int = 5

    def __post_init__(self) -> None:
        for name in ("steps", "state_size", "action_size", "features", "width", "window"):
            low = 0 if name in ("action_size", "width") else 1
            if getattr(self, name) < low:
                raise UserError(f"embedding: {name} = {getattr(self, name)}: must be at least {low}")
        if self.window > self.steps:
            raise UserError(f"embedding: window = {self.window}: a trajectory of {self.steps} steps allows 1 to that")

    @property
    def row_size(self) -> int:
        """Columns of summary_learned: (2 T + 1) S + T A + T."""
        return (2 * self.steps + 1) * self.state_size + self.steps * (self.action_size + 1)

    def size(self, columns: int) -> int:
        """Features of rows with this many columns: the learned ones and the context."""
        self._check(columns)
        return self.features + columns - self.row_size

    def unpack(self, rows: Array) -> tuple[Array, Array, Array, Array, Array]:
        """rows [..., D] -> states [..., T+1, S], changes [..., T, S], actions [..., T, A], valid [..., T], context."""
        self._check(rows.shape[-1])
        steps, s, a = self.steps, self.state_size, self.action_size
        ends = list(accumulate([(steps + 1) * s, steps * s, steps * a, steps]))
        states, changes, actions, valid, context = jnp.split(rows, ends, axis=-1)
        lead = rows.shape[:-1]
        changes, actions = changes.reshape(*lead, steps, s), actions.reshape(*lead, steps, a)
        return states.reshape(*lead, steps + 1, s), changes, actions, valid, context

    def scales(self, rows: Array, ok: Array) -> tuple[Array, Array]:
        """mean [D] and rate [D] = 1 / sd (0 where nothing varies) over the rows [N, D] with ok [N], by channel."""
        states, changes, actions, valid, context = self.unpack(rows)
        usable = ok[:, None].astype(rows.dtype)
        ran = jnp.where(usable > 0, valid, 0.0)
        seen = jnp.concatenate([usable, ran], axis=1)  # the first state, and the state after each step
        moments = [
            (*_moments(states, seen), self.steps + 1),
            (*_moments(changes, ran), self.steps),
            (*_moments(actions, ran), self.steps),
            (jnp.zeros(1), jnp.ones(1), self.steps),
            (*_moments(context[:, None], usable), 1),
        ]
        mean = jnp.concatenate([jnp.tile(mean, times) for mean, _, times in moments])
        return mean, jnp.concatenate([jnp.tile(rate, times) for _, rate, times in moments])

    def init(self, key: Array, rows: Array) -> Any:
        """Parameters of a fresh network for rows [B, D]."""
        x, valid, _ = self._inputs(jnp.zeros((1, rows.shape[-1])))
        params: Any = self._network.init(key, x, valid)
        return params

    def apply(self, params: Any, rows: Array) -> Array:
        """Features [..., F] of standardised rows [..., D]; what lies after the end of an episode does not count."""
        x, valid, context = self._inputs(rows)
        learned: Any = self._network.apply(params, x, valid)
        return jnp.concatenate([learned, context], axis=-1)

    @property
    def _network(self) -> _Network:
        return _Network(self.width or 2 * self.features, self.window, self.features)

    def _inputs(self, rows: Array) -> tuple[Array, Array, Array]:
        states, changes, actions, valid, context = self.unpack(rows)
        valid = (valid > 0.5).astype(rows.dtype)
        time = jnp.broadcast_to(jnp.linspace(-1.0, 1.0, self.steps)[:, None], (*valid.shape, 1))
        x = jnp.concatenate([time, states[..., :-1, :], changes, actions], axis=-1)
        return x * valid[..., None], valid, context

    def _check(self, columns: int) -> None:
        if columns < self.row_size:
            raise UserError(
                f"embedding: rows of {columns} columns; {self.steps} steps of {self.state_size} states and "
                f"{self.action_size} actions need {self.row_size}: use the rows of summary_learned"
            )


def _moments(x: Array, weights: Array) -> tuple[Array, Array]:
    """Mean and 1 / sd [C] of x [N, T, C] over N and T with weights [N, T]; rate 0 for a channel that does not vary."""
    total, weights = jnp.maximum(jnp.sum(weights), 1.0), weights[..., None]
    mean = jnp.sum(weights * x, axis=(0, 1)) / total
    sd = jnp.sqrt(jnp.sum(weights * (x - mean[None, None]) ** 2, axis=(0, 1)) / total)
    return mean, inverse_spread(mean, sd)


def summary_learned(states: Array, actions: Array, valid: Array | None = None) -> Array:
    """Return the trajectory itself for a network that learns its features -> [(2 T + 1) S + T A + T].

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
