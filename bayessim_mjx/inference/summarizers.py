"""The summaries by their names: functions of the *whole* trajectory, streaming forms, names of features (summaries/).

Functions are pure and vmappable. A streaming form computes the summary step by step inside a rollout, so that the
trajectory need not be stored: corr, corrdiff (any lags) and both signatures stream in memory of their own size. start
and waypts *are* rows of the trajectory, and summary_learned is the whole of it: for those the trajectory is stored.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.config.names import SUMMARIES
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summaries
from bayessim_mjx.inference.summaries import Stream, Summarizer
from bayessim_mjx.inference.summaries.correlations import summary_corr, summary_corrdiff, summary_start, summary_waypts
from bayessim_mjx.inference.summaries.learned import summary_learned
from bayessim_mjx.inference.summaries.signatures import summary_logsignature, summary_signatory

__all__ = [
    "Stream", "Summarizer", "feature_names", "get", "size", "stream", "summary_corr", "summary_corrdiff",
    "summary_learned", "summary_logsignature", "summary_signatory", "summary_start", "summary_waypts",
]  # fmt: skip


def get(name: str, **options: Any) -> Summarizer:
    """Find the summarizer of that name, options bound.

    `summary_` may be left out, and a number at the end is its option: start_<steps>, waypts_<waypoints>, corr_<lags>,
    corrdiff_<lags>, signatory_<depth>, logsignature_<depth>.
    """
    summary, given = summaries.entry(name)
    options = {**given, **options}
    return partial(summary.function, **options) if options else summary.function


def size(summarizer: Summarizer, steps: int, state_size: int, action_size: int) -> int:
    """Count the features for trajectories of `steps` actions; UserError where there are too many or too few steps."""
    states = jax.ShapeDtypeStruct((steps + 1, state_size), jnp.float32)
    actions = jax.ShapeDtypeStruct((steps, action_size), jnp.float32)
    found = jax.eval_shape(summarizer, states, actions)
    if getattr(found, "ndim", None) != 1:
        raise UserError(f"a summary gives one row of features [D], not {found}")
    return found.shape[0]


def stream(name: str, steps: int, state_size: int, action_size: int, **options: int) -> Stream:
    """Find the streaming form of summarizer `name` for trajectories of `steps` actions; names and options as in `get`.

    Raises:
        UserError: if the summary has no streaming form, is too large, or `steps` are too few.
    """
    summary, given = summaries.entry(name)
    if summary.stream is None:
        others = [n.removeprefix("summary_") for n in summaries.names() if summaries.entry(n)[0].stream is not None]
        raise UserError(f"{summary.name} has no streaming form; {', '.join(others[:-1])} and {others[-1]} have one")
    return summary.stream(steps, state_size, action_size, **{**given, **options})


def feature_names(summary: str, steps: int, states: Sequence[str], actions: Sequence[str]) -> tuple[str, ...]:
    """Name every feature of `summary` (as in `get`) of trajectories of `steps` actions, in order.

    Raises:
        UserError: a user's own summary that fails, or gives other numbers of names and features.
    """
    entry, options = summaries.entry(summary)
    if entry.name in SUMMARIES.library and entry.names is not None:
        return tuple(entry.names(steps, states, actions, **options))
    try:
        count = size(get(summary), steps, len(states), len(actions))
        short = entry.name.removeprefix("summary_")
        if entry.names is None:
            return tuple(f"{short} {i + 1}" for i in range(count))
        own = tuple(entry.names(steps, states, actions, **options))
    except Exception as error:
        raise UserError(f"{entry.name} fails on trajectories of {steps} steps: {error}") from error
    if len(own) != count:
        raise UserError(f"{entry.name} names {len(own)} features and gives {count}")
    return own
