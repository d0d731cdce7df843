"""Summaries by inner products over time of states, or of their changes, with actions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.summaries.summary import Stream, Summary, affordable, at_steps, held, register


def summary_corrdiff(states: Array, actions: Array, valid: Array | None = None, lags: int = 0) -> Array:
    """Cross-correlations of state differences with actions (BayesSim, RSS 2019, eq. 22) -> [(lags+1) S A + 2 S].

    tau_t = s_{t+1} - s_t, the change that follows a_t;  psi = ({<tau_i, a_j>}, E[tau], Var[tau]), inner products over
    time, mean and variance per state dimension. `lags` adds <tau_i shifted l steps later, a_j> for l = 1..lags
    (the paper has lag 0 only; lags show delays and slow modes).
    """
    states, actions = held(states, actions, valid)
    tau = states[1:] - states[:-1]
    products = _products("summary_corrdiff", tau, actions, lags)
    return jnp.concatenate([products, jnp.mean(tau, axis=0), jnp.var(tau, axis=0)])


def summary_corr(states: Array, actions: Array, valid: Array | None = None, lags: int = 0) -> Array:
    """As summary_corrdiff with the states themselves: products with the state before each action, moments over all."""
    states, actions = held(states, actions, valid)
    products = _products("summary_corr", states[:-1], actions, lags)
    return jnp.concatenate([products, jnp.mean(states, axis=0), jnp.var(states, axis=0)])


def _products(name: str, tau: Array, actions: Array, lags: int) -> Array:
    (steps, s), a = tau.shape, actions.shape[1]
    _check_lags(name, lags, steps)
    affordable(name, (lags + 1) * s * a + 2 * s, "fewer lags, waypts")
    return jnp.concatenate([(tau[lag:].T @ actions[: steps - lag]).reshape(-1) for lag in range(lags + 1)])


def _check_lags(name: str, lags: int, steps: int) -> None:
    if not 0 <= lags < steps:
        raise UserError(f"{name}: lags = {lags}: a trajectory of {steps} steps allows 0 to {steps - 1}")


def _names(steps: int, states: Sequence[str], actions: Sequence[str], lags: int = 0, *, differences: bool) -> list[str]:
    kinds = [f"change of {name}" for name in states] if differences else list(states)
    pairs = [(lag, s, a) for lag in range(lags + 1) for s in kinds for a in actions]
    products = [f"corr({s}, {a})" + (f" lag {lag}" if lags else "") for lag, s, a in pairs]
    return [*products, *(f"mean of {s}" for s in kinds), *(f"variance of {s}" for s in kinds)]


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


def _stream(name: str, steps: int, state_size: int, action_size: int, lags: int = 0, *, differences: bool) -> Stream:
    _check_lags(name, lags, steps)

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


CORR = register(
    Summary(
        "summary_corr", summary_corr, "lags", partial(_names, differences=False),
        partial(_stream, "summary_corr", differences=False),
    )
)  # fmt: skip
CORRDIFF = register(
    Summary(
        "summary_corrdiff", summary_corrdiff, "lags", partial(_names, differences=True),
        partial(_stream, "summary_corrdiff", differences=True),
    )
)  # fmt: skip


# Summaries that are rows of the trajectory: all of them, or those at a few times


def summary_start(states: Array, actions: Array, valid: Array | None = None, steps: int | None = None) -> Array:
    """All (s_t, a_t) flattened time-major, then the last state -> [n (S+A) + S], n = `steps` or all T.

    `steps` keeps only the first steps of a longer trajectory (BayesSimIG always cut to 10).
    """
    states, actions = held(states, actions, valid)
    total = actions.shape[0]
    n = total if steps is None else steps
    if not 1 <= n <= total:
        raise UserError(f"summary_start: steps = {n}: a trajectory of {total} steps allows 1 to {total}")
    affordable("summary_start", n * (states.shape[1] + actions.shape[1]) + states.shape[1], "fewer steps, waypts")
    pairs = jnp.concatenate([states[:n], actions[:n]], axis=1)
    return jnp.concatenate([pairs.reshape(-1), states[n]])


def _start_names(total: int, states: Sequence[str], actions: Sequence[str], steps: int | None = None) -> list[str]:
    last = total if steps is None else steps
    return [*at_steps(range(last), (*states, *actions)), *at_steps([last], states)]


def summary_waypts(states: Array, actions: Array, valid: Array | None = None, waypoints: int | None = None) -> Array:
    """(s_t, a_t) at times spread evenly over the trajectory -> [W (S+A)], W = `waypoints` or min(10, T+1)."""
    states, actions = held(states, actions, valid)
    at = waypoint_times(actions.shape[0], waypoints)
    affordable("summary_waypts", len(at) * (states.shape[1] + actions.shape[1]), "fewer waypoints")
    # the last state follows the last action: it is paired with that one
    return jnp.concatenate([states[at], actions[np.minimum(at, actions.shape[0] - 1)]], axis=1).reshape(-1)


def waypoint_times(steps: int, waypoints: int | None = None) -> np.ndarray:
    """Place the waypoints in a trajectory of `steps` actions."""
    count = min(10, steps + 1) if waypoints is None else waypoints
    if not 1 <= count <= steps + 1:
        raise UserError(f"summary_waypts: waypoints = {count}: {steps} steps have 1 to {steps + 1} states")
    return np.rint(np.linspace(0, steps, count)).astype(np.int32)


def _waypts_names(steps: int, states: Sequence[str], actions: Sequence[str], waypoints: int | None = None) -> list[str]:
    at = waypoint_times(steps, waypoints)
    # the last state follows the last action
    return [f"{n} at step {min(t, steps - 1) if n in actions else t}" for t in at for n in (*states, *actions)]


START = register(Summary("summary_start", summary_start, "steps", _start_names))
WAYPTS = register(Summary("summary_waypts", summary_waypts, "waypoints", _waypts_names))
