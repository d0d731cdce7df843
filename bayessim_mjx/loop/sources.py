"""Where real trajectories come from: a surrogate real (the simulator at hidden parameters), or recorded logs.

Both are turned into summaries by the same function as the simulated trajectories, so the features always mean the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import number as finite
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summarizers
from bayessim_mjx.loop.collection import Seen, policy_function
from bayessim_mjx.loop.recorded import Recorded, recorded
from bayessim_mjx.loop.surrogate import Surrogate
from bayessim_mjx.parameters import ParameterSpace, limits

__all__ = ["Recorded", "Seen", "Source", "Surrogate", "limits_of", "make_source", "policy_function", "real_parameters"]

Source = Surrogate | Recorded


def make_source(config: Config, env: Env) -> Source:
    """The real side that `config` asks for: logs if `real.logs` is set, else the surrogate of `env.realParams`."""
    summarizer = summarizers.get(config.bayessim.summarizerFxn)
    if config.real.logs:
        return recorded(config, env, summarizer)
    if config.bayessim.collectPolicy == "policy_replay":
        raise UserError("bayessim.collectPolicy=policy_replay replays logged commands and needs real.logs=DIR")
    b = config.bayessim
    ends = limits_of(env) if b.range_ends == "move" else None  # reality may lie beyond a range that may move
    weights, means, sds = real_parameters(config.env.realParams, env.space, ends)
    return Surrogate(
        env, env.space, weights, means, sds, b.collectPolicy, b.trainTrajLen, config.real.noise, summarizer, ends
    )


def real_parameters(
    settings: Any, space: ParameterSpace, ends: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """weights [K], means [K, d], sds [K, d] of `env.realParams`; a one-number list stands for every parameter.

    Means lie in the ranges of `space`, or where these may move within `ends`, (lowest, highest) [d].

    Rows may leave the effects' parameters out: these are nominal (as a diagnosis identified them, or neutral).

    Unlike BayesSimIG, `stds` are standard deviations (there they were used as variances).

    Raises:
        UserError: naming the key, its value and what is allowed.
    """
    if not settings:
        raise UserError(
            "env.realParams is missing: give the surrogate's parameters, or real.logs=DIR for recorded motion"
        )
    if "means" not in settings:
        raise UserError(
            f"env.realParams.means is missing (there is only {', '.join(settings)}): expected {_rows_of(space)}"
        )
    means = _rows("means", settings["means"], space, space.nominal)
    stds = _rows("stds", settings.get("stds", [[0.0]] * len(means)), space, np.zeros(len(space)))
    given = settings.get("weights", [1.0] * len(means))
    if not isinstance(given, list | tuple) or not given:
        raise UserError(f"env.realParams.weights = {given!r}: expected a list of one number >= 0 per row of means")
    weights = np.asarray([_number(f"weights[{i}]", w) for i, w in enumerate(given)])
    if not len(means) == len(stds) == len(weights):
        raise UserError(
            f"env.realParams: {len(weights)} weights, {len(means)} means, {len(stds)} stds; one of each per component"
        )
    if np.any(weights < 0) or weights.sum() <= 0:
        raise UserError(f"env.realParams.weights={list(weights)}: must be >= 0 and not all 0")
    for row in means:
        for name, value, low, high in zip(space.names, row, *(ends or (space.low, space.high)), strict=True):
            if not low <= np.float32(value) <= high:  # the ends of a range are rounded as well
                raise UserError(f"env.realParams.means: {name}={value:g} lies outside its range [{low:g}, {high:g}]")
    if any(np.any(row < 0) for row in stds):
        raise UserError("env.realParams.stds must be >= 0")
    return (
        (weights / weights.sum()).astype(np.float32),
        np.asarray(means, dtype=np.float32),
        np.asarray(stds, dtype=np.float32),
    )


def _rows(key: str, value: Any, space: ParameterSpace, rest: np.ndarray) -> list[np.ndarray]:
    """Rows [d], one per component; a single mapping or flat list is one component. `rest` [d]: effects left out."""
    if not isinstance(value, dict | list | tuple) or not value:
        raise UserError(f"env.realParams.{key} = {value!r}: expected {_rows_of(space)}")
    many = not isinstance(value, dict) and any(isinstance(row, dict | list | tuple) for row in value)
    return [_row(f"{key}[{i}]", row, space, rest) for i, row in enumerate(value if many else [value])]


def _rows_of(space: ParameterSpace) -> str:
    return f"one row per component, a list of numbers for {', '.join(space.names)}, or {{name: number}}"


def _number(key: str, value: Any) -> float:
    found = finite(value)
    if found is None:
        raise UserError(f"env.realParams.{key} = {value!r}: expected a number")
    return found


def _row(key: str, row: Any, space: ParameterSpace, rest: np.ndarray) -> np.ndarray:
    if not isinstance(row, dict | list | tuple) or not row:
        raise UserError(f"env.realParams.{key} = {row!r}: expected {_rows_of(space)}")
    if isinstance(row, dict):
        for name in row:
            space.index(name)
        missing = [p.name for p in space.parameters if p.name not in row and p.kind != "effect"]
        if missing:
            raise UserError(f"env.realParams.{key}: no value for {', '.join(missing)}")
        known = zip(space.names, rest, strict=True)
        return np.asarray([_number(f"{key}.{name}", row.get(name, value)) for name, value in known])
    numbers = [_number(f"{key}[{i}]", value) for i, value in enumerate(row)]
    if len(numbers) == 1:
        return np.full(len(space), numbers[0])
    model = [i for i, p in enumerate(space.parameters) if p.kind != "effect"]  # the first of theta
    if len(row) == len(model):
        return np.asarray([*numbers, *rest[len(model) :]])
    if len(row) != len(space):
        raise UserError(
            f"env.realParams.{key} has {len(row)} numbers, the task has {len(space)} parameters: "
            f"{', '.join(space.names)}"
        )
    return np.asarray(numbers)


def limits_of(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest theta [d] that have a meaning in this environment.

    An effect's memory is as long as the range that it begins with, and nothing can be remembered beyond it.
    """
    physics, model = getattr(env, "physics", None), getattr(env, "mj_model", None)
    if physics is None:
        ends = [limits.ends(p) for p in env.space.parameters]
    else:
        ends = [limits.ends(p, model) for p in physics.blocks[0].parameters]
        for p, q in (pair for block in physics.blocks[1:] for pair in block.pairs()):
            ends.append((q.ends()[0], p.high if q.remembered else q.ends()[1]))
    low, high = np.asarray(ends, np.float64).reshape(-1, 2).T
    return low, high
