"""Segments of recorded logs as real trajectories, and their replay as simulated ones."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.config import Config
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.numbers import AT_ONCE
from bayessim_mjx.inference.summaries import Summarizer
from bayessim_mjx.keys import branch
from bayessim_mjx.logs import Channels, Log, noise, read_logs, segments
from bayessim_mjx.logs.velocities import trusted
from bayessim_mjx.loop.collection import SummaryInputs, tiled
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import controllers
from bayessim_mjx.physics.controllers import Law
from bayessim_mjx.physics.tangent import in_tangent, noisy
from bayessim_mjx.rl import Policy
from bayessim_mjx.rollout import Trajectory, recording, remembered, replay
from bayessim_mjx.tracking import Record

# error of a velocity estimated from positions, in its noise: it lags at transients; source: rule of thumb, not counted
ESTIMATED_SPEED = 3.0


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
    order: np.ndarray  # [N] the order in which segments are real trajectories: no two of them share a time
    pool: np.ndarray  # [M] the order of all segments, that simulations begin in
    noise: dict[str, np.ndarray]  # standard deviation of the measurement noise: qpos [nq], qvel [nv]
    # [nv] velocities that were measured and agree with the positions; others are no features: simulation has nothing
    # like their errors
    fast: np.ndarray
    summarizer: Summarizer
    truth: None = None
    policy_dependent: bool = False  # the logged commands act, whatever bayessim.collectPolicy says

    @property
    def supply(self) -> int:
        return len(self.order)

    @property
    def channels(self) -> SummaryInputs:
        """Inputs of the summarizer: deviations from the nominal replay, and commands; then come the first states."""
        named = Channels.of(self.env.mj_model)
        speeds = [f"{name} speed" for name in named.qvel]
        shown = [name for name, there in zip(speeds, self.fast, strict=True) if there]
        states = [f"deviation of {name}" for name in (*named.qpos, *shown)]
        first = tuple(f"first {name}" for name in (*named.qpos, *speeds))
        return SummaryInputs(self.data["command"].shape[1], tuple(states), named.actuators, first)

    def features(self, index: Array | np.ndarray, qpos: Array, qvel: Array) -> Array:
        """[N, D] of measured motion qpos [N, T+1, nq], qvel [N, T+1, nv] under the commands of the segments index [N].

        Both are deviations from the nominal replay of the segment, from its logged start.
        """
        expected_qpos, expected_qvel, command = self._of("expected_qpos", "expected_qvel", "command", index=index)
        away = qvel - expected_qvel
        away = away if self.fast.all() else away[..., np.flatnonzero(self.fast)]
        states = jnp.concatenate([qpos - expected_qpos, away], axis=-1)
        summaries = jax.vmap(self.summarizer)(states, command)
        return jnp.concatenate([summaries, qpos[:, 0], qvel[:, 0]], axis=-1)

    def simulate(self, key: Array, thetas: Array, policy: Policy) -> Array:
        """Replay randomly drawn segments at `thetas` [N, d], with measurement noise; features [N, D].

        The logged first state is a measurement too: the replay starts where the system may really have been.
        """
        return self.measured(key, thetas, policy, 1)[:, 0]

    @property
    def noisy(self) -> bool:
        """Whether sensors add anything."""
        return any(np.any(np.asarray(value) > 0) for value in self.noise.values())

    def measured(self, key: Array, thetas: Array, policy: Policy, draws: int) -> Array:
        """Features [N, draws, D] of replays as of `simulate`, each measured so often."""
        del policy  # the logged commands act
        k_segment, *keys = jax.random.split(key, 5)
        index = jnp.asarray(self.pool)[jax.random.randint(k_segment, (thetas.shape[0],), 0, len(self.pool))]
        qpos0, qvel0 = self._of("qpos0", "qvel0", index=index)
        speed_error = self.noise["qvel"] * np.where(self.fast, 1.0, ESTIMATED_SPEED)
        model = self.env.mj_model
        sd = in_tangent(model, np.asarray(self.noise["qpos"]))
        start = noisy(model, keys[0], qpos0, sd)
        speed = qvel0 + speed_error * jax.random.normal(keys[1], qvel0.shape)
        motion = self._replayed(index, start, speed, thetas)

        def again(draw: Array) -> Array:
            k_qpos, k_qvel = (jnp.where(draw > 0, branch(k, draw), k) for k in keys[2:])
            qpos = noisy(model, k_qpos, motion["qpos"], sd)
            qvel = motion["qvel"] + self.noise["qvel"] * jax.random.normal(k_qvel, motion["qvel"].shape)
            return self.features(index, qpos.at[:, 0].set(qpos0), qvel.at[:, 0].set(qvel0))

        return jnp.moveaxis(jax.lax.map(again, jnp.arange(draws, dtype=jnp.uint32)), 0, 1)

    def truth_of(self, keys: list[Array], count: int) -> None:
        """Nobody knows it."""

    def real(self, key: Array, first: int, count: int, policy: Policy) -> tuple[Array, Trajectory]:
        """Take the next `count` segments of the logs and their features."""
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
        """Replay the segment asked for as number `first` at thetas [n, d]: its motion, see `rollout.replay`."""
        del real
        index = jnp.full(len(thetas), self.order[first % len(self.order)])
        qpos0, qvel0 = self._of("qpos0", "qvel0", index=index)
        return self._replayed(index, qpos0, qvel0, thetas)

    def records(self, index: Array | np.ndarray) -> Record:
        """Take the segments index [N] as they were recorded: with the past of their starts, and their controllers."""
        near = self._of("around_qpos", "around_qvel", "around_command", index=index)
        law = None if self.law is None else jax.tree.map(lambda x: x[index], self.law)
        qpos, qvel, command = self._of("qpos", "qvel", "command", index=index)
        return Record(qpos, qvel, command, recording(self.env.physics, *near), law)

    def _of(self, *names: str, index: Array | np.ndarray) -> list[Array]:
        return [jnp.asarray(self.data[name])[index] for name in names]

    def _replayed(self, index: Array, qpos0: Array, qvel0: Array, thetas: Array) -> dict[str, Array]:
        """Replay the segments index [N] from measured states, as they were recorded: past commands, controllers."""
        record = self.records(index)
        return replay(self.env.physics, qpos0, qvel0, record.command, thetas, record.around, record.law)


def recorded(config: Config, env: Any, summarizer: Summarizer) -> Recorded:
    if not hasattr(env, "physics"):
        raise UserError(f"real.logs needs a task with its own MuJoCo model; {env.name!r} is not one")
    logs: list[Log] = read_logs(config.real.logs, env.mj_model, config.real.map)
    length = config.real.segment_length or config.bayessim.trainTrajLen
    stride = config.real.segment_stride or length
    logs, notes = trusted(logs, max(env.mj_model.opt.timestep, *(log.period for log in logs)))
    data = segments(logs, length, dt=env.dt, stride=stride, rows=remembered(env.physics))
    pool = np.random.default_rng(config.seed).permutation(len(data["qpos0"]))
    order = pool[apart(data["run"], data["start"], length)[pool]]
    needed = config.bayessim.realTrajs
    if len(order) < needed:
        raise UserError(
            f"real.logs: the logs hold {len(order)} segments of {length} steps ({length * env.dt:.3g} s) that share no "
            f"time, bayessim.realTrajs={needed} are needed; shorten bayessim.trainTrajLen or record more"
        )
    if len(order) < len(pool):
        notes.append(
            f"segments overlap (real.segment_stride={stride} of {length} steps): all {len(pool)} are simulated, the "
            f"{len(order)} that share no time are real trajectories, as the same rows count once"
        )
    for note in notes:
        warnings.warn(f"real.logs: {note}", stacklevel=2)
    if config.bayessim.collectPolicy != "policy_replay":
        policy = config.bayessim.collectPolicy
        warnings.warn(f"real.logs: the logged commands act, bayessim.collectPolicy={policy} does not", stacklevel=2)
    fast = np.all([log.seen_speeds for log in logs], axis=0)
    law = controllers.of_logs(logs, env.mj_model)
    law = None if law is None else jax.tree.map(lambda x: x[data["run"]], law)
    source = Recorded(env, env.space, data, law, order, pool, noise(logs), fast, summarizer)
    return dataclasses.replace(source, data=data | _expected(source))


def apart(run: np.ndarray, start: np.ndarray, length: int) -> np.ndarray:
    """[M] whether a segment of `length` steps is one of those, from the first on, that share no time with another.

    Likelihoods and posteriors of segments are multiplied. Rows that two of them share would count twice.
    """
    free, out = dict.fromkeys(np.unique(run).tolist(), -np.inf), np.zeros(len(run), bool)
    for k in np.lexsort((start, run)):
        if start[k] >= free[int(run[k])]:
            out[k], free[int(run[k])] = True, start[k] + length
    return out


def _expected(source: Recorded) -> dict[str, np.ndarray]:
    """Replay the logs at nominal parameters: expected_qpos [M, T+1, nq], expected_qvel [M, T+1, nv]."""
    count = len(source.pool)
    size = min(count, AT_ONCE)
    thetas, found = tiled(jnp.asarray(source.space.nominal, jnp.float32), size), []
    for first in range(0, count, size):
        index = jnp.minimum(first + jnp.arange(size), count - 1)
        qpos0, qvel0 = source._of("qpos0", "qvel0", index=index)
        found.append(jax.tree.map(np.asarray, source._replayed(index, qpos0, qvel0, thetas)))
    return {f"expected_{name}": np.concatenate([part[name] for part in found])[:count] for name in found[0]}
