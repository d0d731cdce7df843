"""The summaries' functions, by their names; each is pure, vmappable, and of the *whole* trajectory (summaries/)."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summaries
from bayessim_mjx.inference.summaries import Summarizer
from bayessim_mjx.inference.summaries.correlations import summary_corr, summary_corrdiff
from bayessim_mjx.inference.summaries.learned import summary_learned
from bayessim_mjx.inference.summaries.rows import summary_start, summary_waypts
from bayessim_mjx.inference.summaries.signatures import summary_logsignature, summary_signatory

__all__ = [
    "Summarizer", "get", "size", "summary_corr", "summary_corrdiff", "summary_learned", "summary_logsignature",
    "summary_signatory", "summary_start", "summary_waypts",
]  # fmt: skip


def get(name: str, **options: Any) -> Summarizer:
    """The summarizer of that name, options bound.

    `summary_` may be left out, and a number at the end is its option: start_<steps>, waypts_<waypoints>, corr_<lags>,
    corrdiff_<lags>, signatory_<depth>, logsignature_<depth>.
    """
    summary, given = summaries.entry(name)
    options = {**given, **options}
    return partial(summary.function, **options) if options else summary.function


def size(summarizer: Summarizer, steps: int, state_size: int, action_size: int) -> int:
    """Number of features for trajectories of `steps` actions; UserError where there are too many or too few steps."""
    states = jax.ShapeDtypeStruct((steps + 1, state_size), jnp.float32)
    actions = jax.ShapeDtypeStruct((steps, action_size), jnp.float32)
    found = jax.eval_shape(summarizer, states, actions)
    if getattr(found, "ndim", None) != 1:
        raise UserError(f"a summary gives one row of features [D], not {found}")
    return found.shape[0]
