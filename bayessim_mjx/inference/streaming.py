"""Summaries computed step by step inside a rollout, so that the trajectory need not be stored.

corr, corrdiff (any lags) and both signatures stream in memory of their own size. start and waypts *are* rows of the
trajectory, and summary_learned is the whole of it: for those the trajectory is stored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.config.settings import summary_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import signature as sig
from bayessim_mjx.inference.summarizers import base_increment, signature_depth


class Stream(NamedTuple):
    """`read(carry)` after all steps equals the summarizer of the same name on the whole trajectory."""

    init: Callable[[Array], Any]  # first state [S] -> carry
    step: Callable[..., Any]  # (carry, action [A], next state [S], valid [] = 1) -> carry
    read: Callable[[Any], Array]  # carry -> features [D]


class _Moments(NamedTuple):
    """Running mean and sum of squared deviations (Welford), for a variance without cancellation."""

    seen: Array  # [] values so far
    mean: Array  # [S]
    squares: Array  # [S]

    def add(self, x: Array) -> _Moments:
        seen, off = self.seen + 1.0, x - self.mean
        mean = self.mean + off / seen
        return _Moments(seen, mean, self.squares + off * (x - mean))


class _Corr(NamedTuple):
    state: Array  # [S]
    recent: Array  # [lags+1, A] the last actions, newest first
    products: Array  # [lags+1, S, A]
    moments: _Moments


def stream(name: str, steps: int, state_size: int, action_size: int, **options: int) -> Stream:
    """The streaming form of summarizer `name` for trajectories of `steps` actions; names and options as in `get`.

    Raises:
        UserError: if the summary has no streaming form, is too large, or `steps` are too few.
    """
    full, given = summary_of(name)
    options = {**given, **options}
    if full in ("summary_corr", "summary_corrdiff"):
        lags = options.get("lags", 0)
        if not 0 <= lags < steps:
            raise UserError(f"{full}: lags = {lags}: a trajectory of {steps} steps allows 0 to {steps - 1}")
        return _correlation(full == "summary_corrdiff", state_size, action_size, lags)
    if full in ("summary_signatory", "summary_logsignature"):
        depth = signature_depth(full, 1 + state_size + action_size, options.get("depth"))
        return _signature(full == "summary_logsignature", steps, state_size, action_size, depth)
    raise UserError(f"{full} has no streaming form; corr, corrdiff, signatory and logsignature have one")


def _correlation(differences: bool, state_size: int, action_size: int, lags: int) -> Stream:
    def init(state: Array) -> _Corr:
        zeros = jnp.zeros((lags + 1, action_size)), jnp.zeros((lags + 1, state_size, action_size))
        moments = _Moments(jnp.float32(0), jnp.zeros(state_size), jnp.zeros(state_size))
        return _Corr(state, *zeros, moments if differences else moments.add(state))

    def step(carry: _Corr, action: Array, state: Array, valid: Array | float = 1.0) -> _Corr:
        # after the end: standing still, the last action held
        state = jnp.where(valid > 0, state, carry.state)
        action = jnp.where(valid > 0, action, carry.recent[0])
        recent = jnp.concatenate([action[None], carry.recent[:-1]])
        change = state - carry.state
        left = change if differences else carry.state
        products = carry.products + left[None, :, None] * recent[:, None, :]
        return _Corr(state, recent, products, carry.moments.add(change if differences else state))

    def read(carry: _Corr) -> Array:
        moments = carry.moments
        return jnp.concatenate([carry.products.reshape(-1), moments.mean, moments.squares / moments.seen])

    return Stream(init, step, read)


def _signature(logarithm: bool, steps: int, state_size: int, action_size: int, depth: int) -> Stream:
    def init(state: Array) -> tuple[Array, Array, sig.Levels]:
        return state, jnp.zeros(action_size), sig.exp(base_increment(state, action_size), depth)

    def step(
        carry: tuple[Array, Array, sig.Levels], action: Array, state: Array, valid: Array | float = 1.0
    ) -> tuple[Array, Array, sig.Levels]:
        before, previous, levels = carry
        state, action = jnp.where(valid > 0, state, before), jnp.where(valid > 0, action, previous)
        jump = jnp.concatenate([jnp.zeros(1 + state_size), action - previous])
        move = jnp.concatenate([jnp.full(1, 1.0 / steps), state - before, jnp.zeros(action_size)])
        return state, action, sig.times_line(sig.times_line(levels, jump), move)

    def read(carry: tuple[Array, Array, sig.Levels]) -> Array:
        return sig.flatten(sig.lyndon(sig.log(carry[2])) if logarithm else carry[2])

    return Stream(init, step, read)
