"""What the numbers of a summary mean, in words: "corr(angle, torque) lag 1"."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product

from bayessim_mjx.config.settings import summary_of
from bayessim_mjx.inference import signature as sig
from bayessim_mjx.inference.summarizers import signature_depth, waypoint_times


def names(summary: str, steps: int, states: Sequence[str], actions: Sequence[str]) -> tuple[str, ...]:
    """A name for every feature of `summary` (as in summarizers.get) of trajectories of `steps` actions, in order."""
    full, options = summary_of(summary)
    if full in ("summary_corr", "summary_corrdiff"):
        return tuple(_correlations(full == "summary_corrdiff", states, actions, options.get("lags", 0)))
    if full in ("summary_signatory", "summary_logsignature"):
        depth = signature_depth(full, 1 + len(states) + len(actions), options.get("depth"))
        return tuple(_words(full == "summary_logsignature", ["time", *states, *actions], depth))
    if full == "summary_waypts":
        at = waypoint_times(steps, options.get("waypoints"))
        # the last state follows the last action
        return tuple(f"{n} at step {min(t, steps - 1) if n in actions else t}" for t in at for n in (*states, *actions))
    if full == "summary_start":
        last = options.get("steps", steps)
        return (*_at(range(last), (*states, *actions)), *_at([last], states))
    changes = [f"change of {name}" for name in states]
    whole = _at(range(steps + 1), states), _at(range(steps), changes), _at(range(steps), actions)
    return tuple(name for part in whole for name in part) + tuple(f"whether step {t} ran" for t in range(steps))


def _at(times: Iterable[int], channels: Sequence[str]) -> list[str]:
    return [f"{name} at step {t}" for t in times for name in channels]


def _correlations(differences: bool, states: Sequence[str], actions: Sequence[str], lags: int) -> list[str]:
    kinds = [f"change of {name}" for name in states] if differences else list(states)
    pairs = [(lag, s, a) for lag in range(lags + 1) for s in kinds for a in actions]
    products = [f"corr({s}, {a})" + (f" lag {lag}" if lags else "") for lag, s, a in pairs]
    return [*products, *(f"mean of {s}" for s in kinds), *(f"variance of {s}" for s in kinds)]


def _words(logarithm: bool, channels: Sequence[str], depth: int) -> list[str]:
    """Iterated integrals by the channels they run over; those of a logarithm as nested areas, by their Lyndon words."""
    levels = [list(product(channels, repeat=k)) for k in range(1, depth + 1)]
    if logarithm:
        where = sig.lyndon_words(len(channels), depth)
        levels = [[level[i] for i in index] for level, index in zip(levels, where, strict=True)]
    kind = "log-signature" if logarithm else "signature"
    return [f"{kind}({', '.join(word)})" for level in levels for word in level]
