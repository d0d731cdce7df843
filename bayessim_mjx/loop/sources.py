"""Trajectories for inference: who acts while they are collected, and where the real ones come from.

A *source* gives real trajectories: a surrogate real (the simulator at hidden parameters) or recorded logs. Both are
turned into summaries by the same function as the simulated trajectories, so the features always mean the same.
"""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import number as finite
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import feature_names, summarizers
from bayessim_mjx.inference.embedding import Embedding
from bayessim_mjx.logs import Channels, Log, noise, read_logs, segments
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import controllers
from bayessim_mjx.physics.controllers import Law
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, recording, remembered, replay, rollout

ESTIMATED_SPEED = 3.0  # error of a velocity estimated from positions, in its noise part: it lags at transients
REPLAYED = 512  # segments replayed at once at nominal parameters
RANDOM_SHARE = 0.1  # policy_rl_randomized: share of the steps with a uniformly random action (BayesSimIG)
POLICY_DEPENDENT = ("policy_rl", "policy_rl_randomized")


def policy_function(name: str, policy: Policy, action_size: int, memory: int = 0) -> Callable[[Array, dict], Array]:
    """The collection policy `name` as a function (key, obs of one world) -> action [action_size].

    memory: numbers at the end of an action that are the policy's memory (`rl.recurrent`), 0 where it is not asked.
    random is symmetric, U[-1, 1]; rl_randomized flips its coin for every world and step by itself. The policy's arrays
    are leaves of the function, so a new policy does not recompile.
    """
    if name == "policy_rl":
        return jax.tree_util.Partial(_act, policy)
    if name == "policy_rl_randomized":
        return jax.tree_util.Partial(_randomized(memory), policy)
    return {"policy_random": _random, "policy_ones": _ones}[name](action_size - memory, memory)


def _act(policy: Policy, key: Array, obs: dict) -> Array:
    return dataclasses.replace(policy, deterministic=False).act(key, obs)


@functools.lru_cache  # the same function again, which does not recompile
def _randomized(memory: int) -> Callable[[Policy, Array, dict], Array]:
    def act(policy: Policy, key: Array, obs: dict) -> Array:
        k_coin, k_random, k_policy = jax.random.split(key, 3)
        action = _act(policy, k_policy, obs)
        acted, remembered = jnp.split(action, [action.shape[-1] - memory])
        other = jax.random.uniform(k_random, acted.shape, minval=-1.0, maxval=1.0)
        return jnp.concatenate([jnp.where(jax.random.bernoulli(k_coin, RANDOM_SHARE), other, acted), remembered])

    return act


@functools.lru_cache
def _random(actions: int, memory: int) -> Callable[[Array, dict], Array]:
    return lambda key, obs: jnp.pad(jax.random.uniform(key, (actions,), minval=-1.0, maxval=1.0), (0, memory))


@functools.lru_cache
def _ones(actions: int, memory: int) -> Callable[[Array, dict], Array]:
    return lambda key, obs: jnp.pad(jnp.ones(actions), (0, memory))


def summarise(summarizer: Callable, trajectory: Trajectory) -> Array:
    """Features [worlds, D] of trajectories, from observations and actions while the episodes ran."""
    return jax.vmap(summarizer)(trajectory.observation, trajectory.action, trajectory.valid)


@dataclasses.dataclass(frozen=True)
class Seen:
    """What a summarizer is given, by name."""

    steps: int
    states: tuple[str, ...]
    actions: tuple[str, ...]
    context: tuple[str, ...] = ()  # features after those of the summary

    def features(self, summary: str) -> tuple[str, ...]:
        """A name for every feature."""
        return (*feature_names.names(summary, self.steps, self.states, self.actions), *self.context)

    def embedding(self) -> Embedding:
        """The network that learns its features from summary_learned."""
        window = min(Embedding.window, self.steps)
        return Embedding(self.steps, len(self.states), len(self.actions), window=window)


def _named(names: Sequence[str], size: int, kind: str) -> tuple[str, ...]:
    return tuple(names) if len(names) == size else tuple(f"{kind} {i + 1}" for i in range(size))


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
    summarizer: summarizers.Summarizer

    @property
    def truth(self) -> np.ndarray:
        """Mean of the heaviest component [d]: the line in the plots and the point that is scored."""
        return self.means[int(np.argmax(self.weights))]

    @property
    def supply(self) -> int | None:
        """How many real trajectories there are; None: as many as asked for."""
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
    def channels(self) -> Seen:
        """What the summarizer sees: observations and actions."""
        (size,) = self.env.observation_size["policy"]
        states = _named(getattr(self.env, "observation_names", ()), size, "observation")
        model = getattr(self.env, "mj_model", None)
        commands = () if model is None else Channels.of(model).actuators
        return Seen(self.length, states, _named(commands, self.env.action_size - self.memory, "action"))

    def sample(self, key: Array, count: int) -> Array:
        """theta [count, d] of the surrogate, inside the box."""
        k_component, k_noise = jax.random.split(key)
        component = jax.random.choice(k_component, len(self.weights), (count,), p=jnp.asarray(self.weights))
        noise_ = jax.random.normal(k_noise, (count, len(self.space)))
        theta = jnp.asarray(self.means)[component] + jnp.asarray(self.sds)[component] * noise_
        return jnp.clip(theta, self.space.low, self.space.high).astype(jnp.float32)

    def simulate(self, key: Array, thetas: Array, policy: Policy) -> Array:
        """Features [N, D] of simulated trajectories at `thetas`."""
        return summarise(self.summarizer, self._observe(key, thetas, policy))

    def _observe(self, key: Array, thetas: Array, policy: Policy) -> Trajectory:
        k_roll, k_noise = jax.random.split(key)
        actions = self.env.action_size
        act = policy_function(self.policy_name, policy, actions, self.memory)
        trajectory = rollout(self.env, act, k_roll, thetas, self.length)
        seen, action = trajectory.observation, trajectory.action[..., : actions - self.memory]
        noisy = seen + self.noise * jax.random.normal(k_noise, seen.shape)
        return dataclasses.replace(trajectory, observation=noisy, action=action)

    def real(self, key: Array, first: int, count: int, policy: Policy) -> tuple[Array, Trajectory]:
        """`count` real trajectories and their features [count, D]; `first` of them were asked for before."""
        del first
        k_theta, k_roll = jax.random.split(key)
        trajectory = self._observe(k_roll, self.sample(k_theta, count), policy)
        return summarise(self.summarizer, trajectory), trajectory

    def repeated(self, first: int, real: Trajectory, thetas: Array) -> dict[str, Array]:
        """The first of the trajectories `real` replayed at thetas [n, d]: its motion, see `rollout.replay`."""
        del first
        first_rows = (real.qpos[:, 0], real.qvel[:, 0], real.command)
        qpos0, qvel0, command = (_tiled(x[0], len(thetas)) for x in first_rows)
        return replay(self.env.physics, qpos0, qvel0, command, thetas)  # type: ignore[attr-defined]


@dataclasses.dataclass(frozen=True, eq=False)  # compared by identity: static under jit
class Recorded:
    """Segments of recorded logs. In simulation the logged commands are replayed from the logged state, as recorded.

    Features are of the *difference* to the replay with nominal parameters, in which the effect of theta is not dwarfed
    by the motion itself, and of the first state.
    """

    env: Any
    space: ParameterSpace
    data: dict[str, np.ndarray]  # of `logs.segments`, M of them; expected_qpos, expected_qvel: of the nominal replay
    law: Law | None  # the controllers that the logs declare, leaves [M, nu]; None: commands go to the actuators
    order: np.ndarray  # [M] the order in which segments are used
    noise: dict[str, np.ndarray]  # standard deviation of the measurement noise: qpos [nq], qvel [nv]
    with_qvel: (
        bool  # velocities were measured; estimated ones are no features, simulation has nothing like their errors
    )
    summarizer: summarizers.Summarizer
    truth: None = None
    policy_dependent: bool = False  # the logged commands act, whatever bayessim.collectPolicy says

    @property
    def supply(self) -> int:
        return len(self.order)

    @property
    def channels(self) -> Seen:
        """What the summarizer sees: deviations from the nominal replay, and commands; then come the first states."""
        named = Channels.of(self.env.mj_model)
        speeds = [f"{name} speed" for name in named.qvel]
        states = [f"deviation of {name}" for name in (*named.qpos, *(speeds if self.with_qvel else ()))]
        first = tuple(f"first {name}" for name in (*named.qpos, *speeds))
        return Seen(self.data["command"].shape[1], tuple(states), named.actuators, first)

    def features(self, index: Array | np.ndarray, qpos: Array, qvel: Array) -> Array:
        """[N, D] of measured motion qpos [N, T+1, nq], qvel [N, T+1, nv] under the commands of the segments index [N].

        Both are deviations from the nominal replay of the segment, from its logged start.
        """
        expected_qpos, expected_qvel, command = self._of("expected_qpos", "expected_qvel", "command", index=index)
        states = qpos - expected_qpos
        if self.with_qvel:
            states = jnp.concatenate([states, qvel - expected_qvel], axis=-1)
        summaries = jax.vmap(self.summarizer)(states, command)
        return jnp.concatenate([summaries, qpos[:, 0], qvel[:, 0]], axis=-1)

    def simulate(self, key: Array, thetas: Array, policy: Policy) -> Array:
        """Replay randomly drawn segments at `thetas` [N, d], with measurement noise; features [N, D].

        The logged first state is a measurement too: the replay starts where the system may really have been.
        """
        del policy  # the logged commands act
        k_segment, *keys = jax.random.split(key, 5)
        index = jnp.asarray(self.order)[jax.random.randint(k_segment, (thetas.shape[0],), 0, len(self.order))]
        qpos0, qvel0 = self._of("qpos0", "qvel0", index=index)
        speed_error = self.noise["qvel"] * (1.0 if self.with_qvel else ESTIMATED_SPEED)
        start = qpos0 + self.noise["qpos"] * jax.random.normal(keys[0], qpos0.shape)
        speed = qvel0 + speed_error * jax.random.normal(keys[1], qvel0.shape)
        motion = self._replayed(index, start, speed, thetas)
        qpos = motion["qpos"] + self.noise["qpos"] * jax.random.normal(keys[2], motion["qpos"].shape)
        qvel = motion["qvel"] + self.noise["qvel"] * jax.random.normal(keys[3], motion["qvel"].shape)
        return self.features(index, qpos.at[:, 0].set(qpos0), qvel.at[:, 0].set(qvel0))

    def real(self, key: Array, first: int, count: int, policy: Policy) -> tuple[Array, Trajectory]:
        """The next `count` segments of the logs and their features."""
        del key, policy
        index = self.order[(first + np.arange(count)) % len(self.order)]
        qpos, qvel, command = self._of("qpos", "qvel", "command", index=index)
        zeros = jnp.zeros(command.shape[:2])
        trajectory = Trajectory(
            observation=jnp.concatenate([qpos, qvel], axis=-1),
            action=command,
            reward=zeros,
            terminated=zeros,
            truncated=zeros,
            valid=zeros + 1.0,
            theta=jnp.zeros((count, len(self.space))),
            qpos=qpos,
            qvel=qvel,
            command=command,
        )
        return self.features(index, qpos, qvel), trajectory

    def repeated(self, first: int, real: Trajectory, thetas: Array) -> dict[str, Array]:
        """The segment asked for as number `first` replayed at thetas [n, d]: its motion, see `rollout.replay`."""
        del real
        index = jnp.full(len(thetas), self.order[first % len(self.order)])
        qpos0, qvel0 = self._of("qpos0", "qvel0", index=index)
        return self._replayed(index, qpos0, qvel0, thetas)

    def _of(self, *names: str, index: Array | np.ndarray) -> list[Array]:
        return [jnp.asarray(self.data[name])[index] for name in names]

    def _replayed(self, index: Array, qpos0: Array, qvel0: Array, thetas: Array) -> dict[str, Array]:
        """The segments index [N] from measured states, as they were recorded: past commands, controllers."""
        physics = self.env.physics
        near = recording(physics, *self._of("around_qpos", "around_qvel", "around_command", index=index))
        law = None if self.law is None else jax.tree.map(lambda x: x[index], self.law)
        (command,) = self._of("command", index=index)
        return replay(physics, qpos0, qvel0, command, thetas, near, law)


Source = Surrogate | Recorded


def make_source(config: Config, env: Env) -> Source:
    """The real side that `config` asks for: logs if `real.logs` is set, else the surrogate of `env.realParams`."""
    summarizer = summarizers.get(config.bayessim.summarizerFxn)
    if config.real.logs:
        return _recorded(config, env, summarizer)
    if config.bayessim.collectPolicy == "policy_replay":
        raise UserError("bayessim.collectPolicy=policy_replay replays logged commands and needs real.logs=DIR")
    weights, means, sds = real_parameters(config.env.realParams, env.space)
    b = config.bayessim
    return Surrogate(
        env, env.space, weights, means, sds, b.collectPolicy, b.trainTrajLen, config.real.noise, summarizer
    )


def _recorded(config: Config, env: Any, summarizer: Callable) -> Recorded:
    if not hasattr(env, "physics"):
        raise UserError(f"real.logs needs a task with its own MuJoCo model; {env.name!r} is not one")
    logs: list[Log] = read_logs(config.real.logs, env.mj_model, config.real.map)
    length = config.real.segment_length or config.bayessim.trainTrajLen
    stride = config.real.segment_stride or length
    data = segments(logs, length, dt=env.dt, stride=stride, rows=remembered(env.physics))
    count = len(data["qpos0"])
    needed = config.bayessim.realTrajs
    if count < needed:
        raise UserError(
            f"real.logs: the logs hold {count} segments of {length} steps ({length * env.dt:.3g} s), "
            f"bayessim.realTrajs={needed} are asked for; shorten bayessim.trainTrajLen or record more"
        )
    if config.bayessim.collectPolicy != "policy_replay":
        policy = config.bayessim.collectPolicy
        warnings.warn(f"real.logs: the logged commands act, bayessim.collectPolicy={policy} does not", stacklevel=2)
    order = np.random.default_rng(config.seed).permutation(count)
    measured = all(log.has_qvel for log in logs)
    law = controllers.of_logs(logs, env.mj_model)
    law = None if law is None else jax.tree.map(lambda x: x[data["run"]], law)
    source = Recorded(env, env.space, data, law, order, noise(logs), measured, summarizer)
    return dataclasses.replace(source, data=data | _expected(source))


def _expected(source: Recorded) -> dict[str, np.ndarray]:
    """What the logs would show at nominal parameters: expected_qpos [M, T+1, nq], expected_qvel [M, T+1, nv]."""
    count = len(source.order)
    size = min(count, REPLAYED)
    thetas, found = _tiled(jnp.asarray(source.space.nominal, jnp.float32), size), []
    for first in range(0, count, size):
        index = jnp.minimum(first + jnp.arange(size), count - 1)
        qpos0, qvel0 = source._of("qpos0", "qvel0", index=index)
        found.append(jax.tree.map(np.asarray, source._replayed(index, qpos0, qvel0, thetas)))
    return {f"expected_{name}": np.concatenate([part[name] for part in found])[:count] for name in found[0]}


def _tiled(x: Array, count: int) -> Array:
    return jnp.broadcast_to(x, (count, *x.shape))


def real_parameters(settings: Any, space: ParameterSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """weights [K], means [K, d], sds [K, d] of `env.realParams`; a one-number list stands for every parameter.

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
        for name, value, low, high in zip(space.names, row, space.low, space.high, strict=True):
            if not low <= value <= high:
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


def domain_or_prior(space: ParameterSpace, components: int, chart: str = "plain") -> Distribution | None:
    """The prior as a distribution with room for `components` Gaussians; None for a task without parameters."""
    return Distribution.prior(space, components, chart) if len(space) else None
