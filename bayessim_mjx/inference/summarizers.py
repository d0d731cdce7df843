"""Fixed-size features of one trajectory, by BayesSimIG's names. Pure and vmappable; they see the *whole* trajectory.

Rows: states[t] is before and states[t + 1] after actions[t]. The network standardises, so nothing is scaled here.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

Summarizer = Callable[[Array, Array], Array]


def summary_start(states: Array, actions: Array, steps: int | None = None) -> Array:
    """All (s_t, a_t) flattened time-major, then the last state: states [T+1, S], actions [T, A] -> [T (S+A) + S].

    `steps` keeps only the first steps of a longer trajectory (BayesSimIG always cut to 10).
    """
    _check(states, actions)
    n = actions.shape[0] if steps is None else min(steps, actions.shape[0])
    pairs = jnp.concatenate([states[:n], actions[:n]], axis=1)
    return jnp.concatenate([pairs.reshape(-1), states[n]])


def summary_waypts(states: Array, actions: Array, waypoints: int = 10) -> Array:
    """(s_t, a_t) at `waypoints` times spread evenly over the trajectory -> [waypoints (S+A)]."""
    _check(states, actions)
    last = actions.shape[0]
    at = np.rint(np.linspace(0, last, min(waypoints, last + 1))).astype(np.int32)
    # the last state follows the last action: it is paired with that one
    return jnp.concatenate([states[at], actions[np.minimum(at, last - 1)]], axis=1).reshape(-1)


def summary_corrdiff(states: Array, actions: Array, lags: int = 0) -> Array:
    """Cross-correlations of state differences with actions (BayesSim, RSS 2019, eq. 22) -> [(lags+1) S A + 2 S].

    tau_t = s_{t+1} - s_t, the change that follows a_t;  psi = ({<tau_i, a_j>}, E[tau], Var[tau]), inner products over
    time, mean and variance per state dimension. `lags` adds <tau_i shifted l steps later, a_j> for l = 1..lags
    (the paper has lag 0 only; lags show delays and slow modes).
    """
    _check(states, actions)
    tau = states[1:] - states[:-1]
    return jnp.concatenate([_products(tau, actions, lags), jnp.mean(tau, axis=0), jnp.var(tau, axis=0)])


def summary_corr(states: Array, actions: Array, lags: int = 0) -> Array:
    """As summary_corrdiff with the states themselves: products with the state before each action, moments over all."""
    _check(states, actions)
    moments = jnp.mean(states, axis=0), jnp.var(states, axis=0)
    return jnp.concatenate([_products(states[:-1], actions, lags), *moments])


def _products(tau: Array, actions: Array, lags: int) -> Array:
    steps = tau.shape[0]
    if not 0 <= lags < steps:
        raise ValueError(f"lags = {lags}: a trajectory of {steps} steps allows 0 to {steps - 1}")
    return jnp.concatenate([(tau[lag:].T @ actions[: steps - lag]).reshape(-1) for lag in range(lags + 1)])


def _check(states: Array, actions: Array) -> None:
    if states.ndim != 2 or actions.ndim != 2 or states.shape[0] != actions.shape[0] + 1 or actions.shape[0] < 1:
        raise ValueError(f"need states [T+1, S] and actions [T, A], not {states.shape} and {actions.shape}")


SUMMARIZERS: dict[str, Callable[..., Array]] = {
    "summary_start": summary_start,
    "summary_waypts": summary_waypts,
    "summary_corr": summary_corr,
    "summary_corrdiff": summary_corrdiff,
}


def get(name: str, **options: Any) -> Summarizer:
    """The summarizer of that name (`summary_` may be left out), options bound: steps, waypoints or lags."""
    full = name if name.startswith("summary_") else f"summary_{name}"
    if full not in SUMMARIZERS:
        close = difflib.get_close_matches(full, SUMMARIZERS, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ValueError(f"unknown summarizer {name!r}{hint}; there are {', '.join(SUMMARIZERS)}")
    return partial(SUMMARIZERS[full], **options) if options else SUMMARIZERS[full]


def size(summarizer: Summarizer, steps: int, state_size: int, action_size: int) -> int:
    """Number of features for trajectories of `steps` actions."""
    states = jax.ShapeDtypeStruct((steps + 1, state_size), jnp.float32)
    actions = jax.ShapeDtypeStruct((steps, action_size), jnp.float32)
    return jax.eval_shape(summarizer, states, actions).shape[0]
