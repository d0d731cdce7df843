"""Sources of real trajectories: a surrogate (the simulator at hidden parameters), or recorded logs (recorded.py).

Both are turned into summaries by the same function as the simulated trajectories, so the features always mean the same.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.compat import brief
from bayessim_mjx.config import Config, freeze, replace
from bayessim_mjx.config.settings import number as finite
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summarizers
from bayessim_mjx.inference.summaries import Summarizer
from bayessim_mjx.keys import branch
from bayessim_mjx.logs import Channels
from bayessim_mjx.loop.collection import POLICY_DEPENDENT, SummaryInputs, named, policy_function, summarise, tiled
from bayessim_mjx.loop.recorded import Recorded, recorded
from bayessim_mjx.parameters import ParameterSpace, ranged
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, replay, rollout


@dataclasses.dataclass(frozen=True, eq=False)  # compared by identity: static under jit
class Surrogate:
    """The simulator at hidden parameters, standing in for hardware (`env.realParams`)."""

    env: Env
    space: ParameterSpace
    weights: np.ndarray  # [K]
    means: np.ndarray  # [K, d]
    sds: np.ndarray  # [K, d]
    policy_name: str
    length: int
    noise: float  # standard deviation of the noise on observations, in simulation and in reality
    summarizer: Summarizer
    ends: tuple[np.ndarray, np.ndarray] | None = None  # lowest, highest theta [d]; None: those of `space`

    @property
    def truth(self) -> np.ndarray:
        """Mean of the heaviest component [d]."""
        return self.means[int(np.argmax(self.weights))]

    def truth_of(self, keys: list[Array], count: int) -> np.ndarray:
        """Mean theta [d] of the trajectories `real(key, .., count, ..)` of these keys.

        Parameters vary from trajectory to trajectory (`env.realParams.stds`), by more than a posterior may be wide.
        Those of the heaviest component count; its mean where it made none.
        """
        drawn = [self._drawn(jax.random.split(key)[0], count) for key in keys]
        component, theta = (
            np.concatenate([np.asarray(part, float) for part in parts]) for parts in zip(*drawn, strict=True)
        )
        heaviest = component == np.argmax(self.weights)
        return theta[heaviest].mean(0).astype(np.float32) if heaviest.any() else self.truth

    @property
    def supply(self) -> int | None:
        """Number of real trajectories; None: there is no limit."""
        return None

    @property
    def policy_dependent(self) -> bool:
        """Whether the trajectories, simulated and real, are made by the policy of their round."""
        return self.policy_name in POLICY_DEPENDENT

    @property
    def memory(self) -> int:
        """Numbers of memory at the end of the policy's actions (`rl.recurrent`)."""
        return getattr(self.env, "memory_size", 0)

    @property
    def channels(self) -> SummaryInputs:
        """Inputs of the summarizer: observations and actions."""
        (size,) = self.env.observation_size["policy"]
        states = named(getattr(self.env, "observation_names", ()), size, "observation")
        model = getattr(self.env, "mj_model", None)
        commands = () if model is None else Channels.of(model).actuators
        return SummaryInputs(self.length, states, named(commands, self.env.action_size - self.memory, "action"))

    def sample(self, key: Array, count: int) -> Array:
        """theta [count, d] of the surrogate, inside the box, or between `ends`."""
        return self._drawn(key, count)[1]

    @partial(brief, static_argnums=(0, 2))
    def _drawn(self, key: Array, count: int) -> tuple[Array, Array]:
        """Components [count] and their theta [count, d]."""
        k_component, k_noise = jax.random.split(key)
        component = jax.random.choice(k_component, len(self.weights), (count,), p=jnp.asarray(self.weights))
        noise_ = jax.random.normal(k_noise, (count, len(self.space)))
        theta = jnp.asarray(self.means)[component] + jnp.asarray(self.sds)[component] * noise_
        low, high = self.ends or (self.space.low, self.space.high)
        return component, jnp.clip(theta, low, high).astype(jnp.float32)

    def simulate(self, key: Array, thetas: Array, policy: Policy) -> Array:
        """Features [N, D] of simulated trajectories at `thetas`."""
        return summarise(self.summarizer, self._observe(key, thetas, policy))

    @property
    def noisy(self) -> bool:
        """Whether sensors add anything."""
        return self.noise > 0

    def measured(self, key: Array, thetas: Array, policy: Policy, draws: int) -> Array:
        """Features [N, draws, D] of trajectories at `thetas`, each measured so often; first those of `simulate`."""
        k_roll, k_noise = jax.random.split(key)
        clean = self._acted(k_roll, thetas, policy)

        def again(draw: Array) -> Array:
            return summarise(self.summarizer, self._noisy(jnp.where(draw > 0, branch(k_noise, draw), k_noise), clean))

        found = jax.lax.map(again, jnp.arange(draws, dtype=jnp.uint32))
        return jnp.moveaxis(found, 0, 1)

    def _observe(self, key: Array, thetas: Array, policy: Policy) -> Trajectory:
        k_roll, k_noise = jax.random.split(key)
        return self._noisy(k_noise, self._acted(k_roll, thetas, policy))

    def _acted(self, key: Array, thetas: Array, policy: Policy) -> Trajectory:
        """Trajectories without measurement noise."""
        actions = self.env.action_size
        act = policy_function(self.policy_name, policy, actions, self.memory)
        trajectory = rollout(self.env, act, key, thetas, self.length)
        return dataclasses.replace(trajectory, action=trajectory.action[..., : actions - self.memory])

    def _noisy(self, key: Array, trajectory: Trajectory) -> Trajectory:
        seen = trajectory.observation
        return dataclasses.replace(trajectory, observation=seen + self.noise * jax.random.normal(key, seen.shape))

    def real(self, key: Array, first: int, count: int, policy: Policy) -> tuple[Array, Trajectory]:
        """`count` real trajectories and their features [count, D]; `first` of them were asked for before."""
        del first
        k_theta, k_roll = jax.random.split(key)
        trajectory = self._observe(k_roll, self.sample(k_theta, count), policy)
        return summarise(self.summarizer, trajectory), trajectory

    def repeated(self, first: int, real: Trajectory, thetas: Array) -> dict[str, Array]:
        """Replay the first of the trajectories `real` at thetas [n, d]: its motion, see `rollout.replay`."""
        del first
        first_rows = (real.qpos[:, 0], real.qvel[:, 0], real.command)
        qpos0, qvel0, command = (tiled(x[0], len(thetas)) for x in first_rows)
        return replay(self.env.physics, qpos0, qvel0, command, thetas)  # type: ignore[attr-defined]


Source = Surrogate | Recorded


def make_source(config: Config, env: Env) -> Source:
    """Make the real side that `config` asks for: logs if `real.logs` is set, else the surrogate of `env.realParams`."""
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


def with_surrogate(config: Config, env: Env) -> Config:
    """Draw hidden parameters by the seed where neither they nor logs are given; effects stay nominal.

    They are of the middle half of each prior: there the posterior shows both of its sides.
    """
    if config.env.realParams is not None or config.real.logs or not len(env.space):
        return config
    unit = np.random.default_rng(config.seed).uniform(0.25, 0.75, len(env.space)).astype(np.float32)
    drawn = np.asarray(env.space.from_unit(jnp.asarray(unit)))
    row = {p.name: float(x) for p, x in zip(env.space.parameters, drawn, strict=True) if p.kind != "effect"}
    return replace(config, env={"realParams": freeze({"means": [row]})}) if row else config


def real_parameters(
    settings: Any, space: ParameterSpace, ends: tuple[np.ndarray, np.ndarray] | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """weights [K], means [K, d], sds [K, d] of `env.realParams`; one number of `stds` stands for every parameter.

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
    if len(numbers) == 1 and key.startswith("stds"):
        return np.full(len(space), numbers[0])
    model = [i for i, p in enumerate(space.parameters) if p.kind != "effect"]  # the first of theta
    if len(row) == len(model):
        return np.asarray([*numbers, *rest[len(model) :]])
    if len(row) != len(space):
        raise UserError(
            f"env.realParams.{key} has {len(row)} number{'s' * (len(row) > 1)}, the task has {len(space)} parameters: "
            f"{', '.join(space.names)}"
        )
    return np.asarray(numbers)


def limits_of(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest theta [d] that have a meaning in this environment.

    An effect's memory is as long as the range that it begins with, and nothing can be remembered beyond it.
    """
    physics, model = getattr(env, "physics", None), getattr(env, "mj_model", None)
    if physics is None:
        ends = [ranged.ends(p) for p in env.space.parameters]
    else:
        ends = [ranged.ends(p, model) for p in physics.blocks[0].parameters]
        for p, q in (pair for block in physics.blocks[1:] for pair in block.pairs()):
            ends.append((q.ends()[0], p.high if q.remembered else q.ends()[1]))
    low, high = np.asarray(ends, np.float64).reshape(-1, 2).T
    return low, high


__all__ = [
    "Recorded",
    "Source",
    "SummaryInputs",
    "Surrogate",
    "limits_of",
    "make_source",
    "policy_function",
    "real_parameters",
    "with_surrogate",
]
