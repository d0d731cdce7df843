"""Summaries that are rows of the trajectory: all of them, or those at a few times."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.summaries.summary import Summary, affordable, at_steps, held, register


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
