"""Summaries: their contract, and the functions that all of them share.

Rows: states[t] is before and states[t + 1] after actions[t]. `valid` [T] is 1 while the episode ran: what comes after
counts as standing still with the last action held, whatever the arrays hold there. The network standardises each
feature, so units and scales of channels do not matter here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.config.names import SUMMARIES
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.numbers import AT_ONCE

Summarizer = Callable[..., Array]  # (states [T+1, S], actions [T, A], valid [T] or nothing) -> [D]
MAX_FEATURES = 16 * AT_ONCE  # 10 000 trajectories of as many features are 0.6 GiB; source: memory alone


class Stream(NamedTuple):
    """A summary step by step: `read(carry)` after all steps equals the function on the whole trajectory."""

    init: Callable[[Array], Any]  # first state [S] -> carry
    step: Callable[..., Any]  # (carry, action [A], next state [S], valid [] = 1) -> carry
    read: Callable[[Any], Array]  # carry -> features [D]


@dataclass(frozen=True)
class Summary:
    """All that is known of one summary. T steps, S state channels, A action channels.

    Args:
        name: summary_<word>; in settings the prefix may be left out.
        function: (states [T+1, S], actions [T, A], valid [T] or None, its option) -> features [D], float32. Pure, for
            jax.jit and jax.vmap; D depends on the shapes and the option alone.
        ending: the option of `function` that a whole number at the end of the name sets; None: it takes none.
        names: (T, names of the states, names of the actions, its option) -> a name for each feature; None: numbers.
        stream: (T, S, A, its option) -> Stream; None: it needs the whole trajectory.
        embedding: (T, S, A) -> a network that learns features from these (learned.py); None: they are features.
    """

    name: str
    function: Summarizer
    ending: str | None = None
    names: Callable[..., Sequence[str]] | None = None
    stream: Callable[..., Stream] | None = None
    embedding: Callable[[int, int, int], Any] | None = None


def register(summary: Summary) -> Summary:
    """Add a summary, so that `bayessim.summarizerFxn` may name it; returns it.

    Raises:
        UserError: a name that is the library's, or that does not begin with summary_.
    """
    return SUMMARIES.register(summary)


def held(states: Array, actions: Array, valid: Array | None = None) -> tuple[Array, Array]:
    """Replace every row after the end of the episode by the last one before it."""
    if states.ndim != 2 or actions.ndim != 2 or states.shape[0] != actions.shape[0] + 1 or actions.shape[0] < 1:
        raise UserError(f"need states [T+1, S] and actions [T, A], T >= 1, not {states.shape} and {actions.shape}")
    if valid is None:
        return states, actions
    if valid.shape != actions.shape[:1]:
        raise UserError(f"valid has shape {valid.shape}: expected {actions.shape[:1]}, one number per action")
    times = jnp.arange(actions.shape[0] + 1)
    last = jnp.sum(valid > 0)  # steps that the episode ran
    return states[jnp.minimum(times, last)], actions[jnp.minimum(times[:-1], jnp.maximum(last - 1, 0))]


def affordable(what: str, count: int, instead: str) -> None:
    """UserError where there are more than MAX_FEATURES features."""
    if count > MAX_FEATURES:
        raise UserError(f"{what} has {count:,} features; at most {MAX_FEATURES:,} are allowed: take {instead}")


def at_steps(times: Sequence[int] | range, channels: Sequence[str]) -> list[str]:
    """Names of the rows of a trajectory, time-major."""
    return [f"{name} at step {t}" for t in times for name in channels]
