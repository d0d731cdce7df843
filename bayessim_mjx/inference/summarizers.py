"""Fixed-size features of one trajectory, by BayesSimIG's names. Pure, vmappable, and of the *whole* trajectory.

Rows: states[t] is before and states[t + 1] after actions[t]. `valid` [T] is 1 while the episode ran: what comes after
counts as standing still with the last action held, whatever the arrays hold there. The network standardises each
feature, so units and scales of channels do not matter here. streaming.py computes corr, corrdiff and the signatures
step by step; embedding.py is the network that learns its features from summary_learned.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.config.settings import summary_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import signature as sig

Summarizer = Callable[..., Array]  # (states [T+1, S], actions [T, A], valid [T] or nothing) -> [D]
MAX_FEATURES = 16384  # 10 000 trajectories of as many features are 0.6 GiB, and a network sees each of them
SIGNATURE_FEATURES = 12100  # BayesSimIG's limit n^depth <= 110^2 of the depth that it takes
SIGNATURE_DEPTH = 3


def summary_start(states: Array, actions: Array, valid: Array | None = None, steps: int | None = None) -> Array:
    """All (s_t, a_t) flattened time-major, then the last state -> [n (S+A) + S], n = `steps` or all T.

    `steps` keeps only the first steps of a longer trajectory (BayesSimIG always cut to 10).
    """
    states, actions = held(states, actions, valid)
    total = actions.shape[0]
    n = total if steps is None else steps
    if not 1 <= n <= total:
        raise UserError(f"summary_start: steps = {n}: a trajectory of {total} steps allows 1 to {total}")
    _affordable("summary_start", n * (states.shape[1] + actions.shape[1]) + states.shape[1], "fewer steps, waypts")
    pairs = jnp.concatenate([states[:n], actions[:n]], axis=1)
    return jnp.concatenate([pairs.reshape(-1), states[n]])


def summary_waypts(states: Array, actions: Array, valid: Array | None = None, waypoints: int | None = None) -> Array:
    """(s_t, a_t) at times spread evenly over the trajectory -> [W (S+A)], W = `waypoints` or min(10, T+1)."""
    states, actions = held(states, actions, valid)
    at = waypoint_times(actions.shape[0], waypoints)
    _affordable("summary_waypts", len(at) * (states.shape[1] + actions.shape[1]), "fewer waypoints")
    # the last state follows the last action: it is paired with that one
    return jnp.concatenate([states[at], actions[np.minimum(at, actions.shape[0] - 1)]], axis=1).reshape(-1)


def waypoint_times(steps: int, waypoints: int | None = None) -> np.ndarray:
    """The rows of the waypoints in a trajectory of `steps` actions."""
    count = min(10, steps + 1) if waypoints is None else waypoints
    if not 1 <= count <= steps + 1:
        raise UserError(f"summary_waypts: waypoints = {count}: {steps} steps have 1 to {steps + 1} states")
    return np.rint(np.linspace(0, steps, count)).astype(np.int32)


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
    if not 0 <= lags < steps:
        raise UserError(f"{name}: lags = {lags}: a trajectory of {steps} steps allows 0 to {steps - 1}")
    _affordable(name, (lags + 1) * s * a + 2 * s, "fewer lags, waypts")
    return jnp.concatenate([(tau[lag:].T @ actions[: steps - lag]).reshape(-1) for lag in range(lags + 1)])


def summary_signatory(
    states: Array, actions: Array, valid: Array | None = None, depth: int | None = None, parallel: bool = False
) -> Array:
    """Signature of the path (time, state, action) -> [n + n^2 + ... + n^depth], n = 1 + S + A; level k times k!.

    The path starts at 0 (so the first state is seen), time runs from 0 to 1, and an action is held during its step, so
    that int a_j ds_i is corrdiff's <tau_i, a_j>. `depth`: see signature_depth. `parallel` multiplies the increments as
    a tree (short paths, GPU) rather than one after the other. Lyons & McLeod 2022, arXiv 2206.14674, for the theory.
    """
    return sig.flatten(_signature("summary_signatory", states, actions, valid, depth, parallel))


def summary_logsignature(
    states: Array, actions: Array, valid: Array | None = None, depth: int | None = None, parallel: bool = False
) -> Array:
    """The logarithm of summary_signatory at Lyndon words: the same information in fewer numbers -> [sum of Witt's].

    Level k has (1/k) sum_{d | k} mu(k/d) n^d entries: n, n(n-1)/2, (n^3-n)/3, ...
    """
    levels = _signature("summary_logsignature", states, actions, valid, depth, parallel)
    return sig.flatten(sig.lyndon(sig.log(levels)))


def _signature(
    name: str, states: Array, actions: Array, valid: Array | None, depth: int | None, parallel: bool
) -> sig.Levels:
    states, actions = held(states, actions, valid)
    depth = signature_depth(name, 1 + states.shape[1] + actions.shape[1], depth)
    return (sig.signature_tree if parallel else sig.signature)(path_increments(states, actions), depth)


def signature_depth(name: str, channels: int, depth: int | None = None) -> int:
    """`depth`, or by default 3, or 2 where channels^3 > 110^2 (BayesSimIG's rule, which went on to a useless 1).

    Raises:
        UserError: where that depth gives more than MAX_FEATURES features, naming the depths that do not.
    """
    if depth is None:
        depth = SIGNATURE_DEPTH if channels**SIGNATURE_DEPTH <= SIGNATURE_FEATURES else 2
    if depth < 1:
        raise UserError(f"{name}: depth = {depth}: must be at least 1")
    size_of = {"summary_signatory": sig.size, "summary_logsignature": sig.log_size}
    if (features := size_of[name](channels, depth)) > MAX_FEATURES:
        most = max(d for d in range(depth) if size_of[name](channels, d) <= MAX_FEATURES)
        others = [f"{name}_{most}"] * (most > 1)
        others += ["summary_logsignature"] * (name == "summary_signatory" and sig.log_size(channels, 2) <= MAX_FEATURES)
        _affordable(f"{name} of depth {depth} over {channels} channels", features, ", ".join([*others, "corrdiff"]))
    return depth


def path_increments(states: Array, actions: Array) -> Array:
    """Steps [2 T + 1, 1 + S + A] of the path (time, state, action) from 0: actions jump, then time and state move."""
    (steps, a), s = actions.shape, states.shape[1]
    jumps = jnp.diff(actions, axis=0, prepend=jnp.zeros((1, a)))
    jumps = jnp.concatenate([jnp.zeros((steps, 1 + s)), jumps], axis=1)
    moves = [jnp.full((steps, 1), 1.0 / steps), jnp.diff(states, axis=0), jnp.zeros((steps, a))]
    both = jnp.stack([jumps, jnp.concatenate(moves, axis=1)], axis=1).reshape(2 * steps, 1 + s + a)
    return jnp.concatenate([base_increment(states[0], a)[None], both])


def base_increment(state: Array, action_size: int) -> Array:
    """From the origin to the first state [S]: without it a signature would not know where the path is."""
    return jnp.concatenate([jnp.zeros(1), state, jnp.zeros(action_size)])


def summary_learned(states: Array, actions: Array, valid: Array | None = None) -> Array:
    """The trajectory itself for a network that learns its features (embedding.py) -> [(2 T + 1) S + T A + T].

    states, their changes s_{t+1} - s_t, actions, valid. Changes have a scale of their own, small beside the states'.
    """
    states, actions = held(states, actions, valid)
    mask = jnp.ones(actions.shape[0]) if valid is None else valid.astype(jnp.float32)
    parts = [states, states[1:] - states[:-1], actions, mask]
    _affordable("summary_learned", sum(part.size for part in parts), "a shorter trajectory, corrdiff")
    return jnp.concatenate([part.reshape(-1) for part in parts])


def held(states: Array, actions: Array, valid: Array | None = None) -> tuple[Array, Array]:
    """The trajectory with every row after the end of the episode replaced by the last one before it."""
    if states.ndim != 2 or actions.ndim != 2 or states.shape[0] != actions.shape[0] + 1 or actions.shape[0] < 1:
        raise UserError(f"need states [T+1, S] and actions [T, A], T >= 1, not {states.shape} and {actions.shape}")
    if valid is None:
        return states, actions
    if valid.shape != actions.shape[:1]:
        raise UserError(f"valid has shape {valid.shape}: expected {actions.shape[:1]}, one number per action")
    times = jnp.arange(actions.shape[0] + 1)
    last = jnp.sum(valid > 0)  # steps that the episode ran
    return states[jnp.minimum(times, last)], actions[jnp.minimum(times[:-1], jnp.maximum(last - 1, 0))]


def _affordable(what: str, count: int, instead: str) -> None:
    if count > MAX_FEATURES:
        raise UserError(f"{what} has {count:,} features; at most {MAX_FEATURES:,} are allowed: take {instead}")


SUMMARIZERS: dict[str, Summarizer] = {
    "summary_start": summary_start,
    "summary_waypts": summary_waypts,
    "summary_corr": summary_corr,
    "summary_corrdiff": summary_corrdiff,
    "summary_signatory": summary_signatory,
    "summary_logsignature": summary_logsignature,
    "summary_learned": summary_learned,
}


def get(name: str, **options: Any) -> Summarizer:
    """The summarizer of that name, options bound.

    `summary_` may be left out, and a number at the end is its option: start_<steps>, waypts_<waypoints>, corr_<lags>,
    corrdiff_<lags>, signatory_<depth>, logsignature_<depth>.
    """
    full, given = summary_of(name)
    options = {**given, **options}
    return partial(SUMMARIZERS[full], **options) if options else SUMMARIZERS[full]


def size(summarizer: Summarizer, steps: int, state_size: int, action_size: int) -> int:
    """Number of features for trajectories of `steps` actions; UserError where there are too many or too few steps."""
    states = jax.ShapeDtypeStruct((steps + 1, state_size), jnp.float32)
    actions = jax.ShapeDtypeStruct((steps, action_size), jnp.float32)
    return jax.eval_shape(summarizer, states, actions).shape[0]
