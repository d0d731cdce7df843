"""Logs in which not every joint was measured: the motion of the others, and whether what was measured tells it.

An extended Kalman filter and smoother (Rauch, Tung and Striebel) of the model as it was delivered runs along each log.
What it finds only says where the windows' start states are first looked for, and how far from there: nothing of it
enters the likelihood. An unknown acceleration, as large as makes the measurements most likely, stands for what the
model lacks. Equality constraints (closed loops, coupled joints) are measurements that follow any motion: they hold as
exactly as the encoders show.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.compat import mass_matrix
from bayessim_mjx.diagnosis.fitting.cutting import CUTTING
from bayessim_mjx.diagnosis.logcheck.drives import DeclaredLaw
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.odometry import base
from bayessim_mjx.physics import controllers
from bayessim_mjx.physics.loops import Loops

Array = NDArray[np.float64]
# rad or m, rad/s or m/s, of finite differences in doubles: the cube root of their precision balances the rounding of
# central ones with their third order. No state is known better
NUDGE = float(np.finfo(float).eps ** (1 / 3))
SIZES = (
    0.3,
    0.03,
    0.003,
)  # of typical accelerations, that the model may lack: the most likely one is taken. Not counted

# standard deviations of a log's first state: a radian or metre, and as much in a window; a rule of thumb
PRIOR = (1.0, 1 / CUTTING.window)


def shortened(logs: Sequence[Log], seconds: float) -> tuple[tuple[Log, ...], list[str]]:
    """Cut logs that lack a joint's motion to the beginnings that hold so many seconds together, and say so.

    To find that motion takes milliseconds a row, and it is tracked from a log's first row on: where a joint is amid a
    log nothing tells. So of long logs their beginnings are filtered, each of its share.
    """
    share = seconds / max(sum(log.duration for log in logs), 1e-9)
    out, left = [], []
    for log in logs:
        stop = int(np.searchsorted(log.time, log.time[0] + share * log.duration, side="right"))
        short = share < 1 and bool(log.lost)
        out.append(log.cut(0, stop) if short else log)
        left += [f"{log.name} the first {out[-1].duration:.3g} of {log.duration:.3g} s"] if short else []
    if not left:
        return tuple(out), []
    more = f" and of {len(left) - 3} more logs their beginnings" if len(left) > 3 else ""
    text = f"not every joint was measured: of {', of '.join(left[:3])}{more} are used, which hold all windows"
    return tuple(out), [text]


def completed(logs: Sequence[Log], model: mujoco.MjModel) -> tuple[tuple[Log, ...], tuple[base.Base, ...]]:
    """Complete the logs with the motion of joints that were not measured, and its standard deviations.

    Args:
        model: as it was delivered.

    Returns:
        The logs, and the motion of a floating base that was estimated, of each log.

    Raises:
        UserError: what was measured does not tell the state of a joint.
    """
    if not any(log.lost for log in logs):
        return tuple(logs), ()
    if floating := base.of_logs(logs, model):
        return tuple(log for log, _ in floating), tuple(found for _, found in floating if found is not None)
    _demand_axial(logs)
    ways = [_smoothed(log, model) if log.lost else None for log in logs]
    _demand([(log, way) for log, way in zip(logs, ways, strict=True) if way is not None], model)
    return tuple(log if way is None else _with(log, way, model) for log, way in zip(logs, ways, strict=True)), ()


@dataclass(frozen=True, eq=False)
class Way:
    """A motion: qpos `[T, nq]`, qvel `[T, nv]`, sd `[T, 2 nv]` and `known [2 nv]`, see `_gained`."""

    qpos: Array
    qvel: Array
    sd: Array
    known: Array


def _with(log: Log, way: Way, model: mujoco.MjModel) -> Log:
    """Guesses in the place of what was not measured; its noise is the typical error of the guess."""
    nv = model.nv
    typical = np.sqrt(np.median(way.sd**2, axis=0))
    qpos, sigma_qpos = log.qpos.copy(), log.sigma_qpos.copy()
    seen = log.seen_dofs
    for joint in log.joints:
        q, v = log.channels.columns(joint), log.channels.columns(joint, "qvel")
        if not seen[v].all():
            qpos[:, q], sigma_qpos[q] = way.qpos[:, q], typical[v]
    guessed = ~log.seen_speeds & ~seen  # a derivative of measured positions stays
    qvel = np.where(guessed, way.qvel, log.qvel)
    sigma_qvel = np.where(guessed, typical[nv:], log.sigma_qvel)
    return dataclasses.replace(log, qpos=qpos, qvel=qvel, sigma_qpos=sigma_qpos, sigma_qvel=sigma_qvel)


def _smoothed(log: Log, model: mujoco.MjModel) -> Way:
    """Return the best of some sizes of what the model lacks; where constraints tell the motion, no model is needed."""
    noise, prior = np.concatenate([log.sigma_dofs, log.sigma_qvel]), np.repeat(PRIOR, model.nv)
    if (bound := Loops(model).followed(log.qpos, log.qvel, noise, log.seen_dofs)) is not None:
        known = (prior / np.maximum(bound[2].max(0), NUDGE)) ** 2 - 1
        if (known > 1).all():
            return Way(*bound, known)
    stepper = Stepper(model, log)
    measured = _Measured.of(log)
    lacking = _accelerations(model, log)
    tried = [_Filter(stepper, log, measured, share * lacking) for share in SIZES]
    return max(tried, key=lambda f: np.nan_to_num(f.likelihood, nan=-np.inf)).smoothed()


def _accelerations(model: mujoco.MjModel, log: Log) -> Array:
    """Typical accelerations `[nv]`: of gravity and of the largest commands, at each joint alone."""
    data, rng, forces = mujoco.MjData(model), np.random.default_rng(0), []
    inertia = np.zeros(model.nv)
    for _ in range(20):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(model, data.qpos, rng.normal(size=model.nv), 1.0)
        data.ctrl[:] = np.percentile(np.abs(log.ctrl), 95, axis=0) if model.nu else 0.0
        mujoco.mj_forward(model, data)
        forces.append(np.abs(data.qfrc_bias) + np.abs(data.qfrc_actuator))
        inertia += np.diag(mass_matrix(model, data)) / 20
    return np.maximum(np.mean(forces, axis=0) / np.maximum(inertia, 1e-12), 1e-3)


@dataclass(frozen=True, eq=False)
class _Measured:
    """Rows of the state `[2 nv]` that are measured, and their noise."""

    rows: NDArray[np.int64]
    sigma: Array

    @classmethod
    def of(cls, log: Log) -> _Measured:
        seen = np.concatenate([log.seen_dofs, log.seen_speeds])
        noise = np.maximum(np.concatenate([log.sigma_dofs, log.sigma_qvel]), NUDGE)
        return cls(np.flatnonzero(seen), noise[seen])


class _Filter:
    """The filter along one log, and what its smoother needs.

    Args:
        lacking: `[nv]`, standard deviation of accelerations that the model lacks.
    """

    def __init__(self, stepper: Stepper, log: Log, measured: _Measured, lacking: Array) -> None:
        self.stepper, self.log, self.measured, self.lacking = stepper, log, measured, lacking
        nv = stepper.nv
        seen = np.concatenate([log.seen_dofs, log.seen_dofs | log.seen_speeds])
        noise = np.maximum(np.concatenate([log.sigma_dofs, log.sigma_qvel]), NUDGE)
        self.prior = np.where(seen, np.minimum(3 * noise, np.repeat(PRIOR, nv)), np.repeat(PRIOR, nv))
        self._run(stepper.loops.closed(log.qpos[0], seen[:nv]), np.where(seen[nv:], log.qvel[0], 0.0))
        qpos, qvel, _ = self._back()
        self._run(qpos[0], qvel[0])  # from the smoothed start: it is linearised there

    def smoothed(self) -> Way:
        qpos, qvel, spread = self._back()
        sd = np.sqrt(np.maximum(np.diagonal(spread, axis1=1, axis2=2), 0.0))
        return Way(qpos, qvel, sd, _gained(self.ways, self.held, self.measured, self.log.period))

    def _run(self, qpos: Array, qvel: Array) -> None:
        log, stepper, nv = self.log, self.stepper, self.stepper.nv
        stepper.reset()
        rows, sigma = self.measured.rows, self.measured.sigma
        spread, self.likelihood = np.diag(self.prior**2), 0.0
        kept: list[tuple[Array, Array, Array]] = []
        predicted: list[tuple[Array, Array, Array]] = []
        ways: list[Array] = []
        held: list[Array] = []
        for k in range(len(log)):
            if k:
                dt = float(log.time[k] - log.time[k - 1])
                qpos, qvel, way = stepper.linearised(qpos, qvel, k - 1)
                push = np.concatenate([0.5 * dt**2 * np.diag(self.lacking), dt * np.diag(self.lacking)])
                spread = way @ spread @ way.T + push @ push.T + NUDGE**2 * np.eye(2 * nv)
                ways.append(way)
            predicted.append((qpos, qvel, spread))
            bound, broken, loose = stepper.bound(qpos, qvel, self.measured)
            seen = np.concatenate([np.eye(2 * nv)[rows], bound])
            gap = np.concatenate([stepper.difference(qpos, qvel, log.qpos[k], log.qvel[k])[rows], -broken])
            inner = seen @ spread @ seen.T + np.diag(np.concatenate([sigma, loose]) ** 2)
            gain = np.linalg.solve(inner, seen @ spread).T
            self.likelihood -= 0.5 * (float(gap @ np.linalg.solve(inner, gap)) + np.linalg.slogdet(inner)[1])
            qpos, qvel = stepper.moved(qpos, qvel, gain @ gap)
            spread = spread - gain @ seen @ spread
            spread = 0.5 * (spread + spread.T)
            held.append(bound / loose[:, None])
            kept.append((qpos, qvel, spread))
        self.kept, self.predicted, self.ways, self.held = kept, predicted, ways, held

    def _back(self) -> tuple[Array, Array, Array]:
        """Smoothed positions, velocities and covariances of all rows."""
        out = [self.kept[-1]]
        for k in range(len(self.ways) - 1, -1, -1):
            qpos, qvel, spread = self.kept[k]
            ahead_q, ahead_v, ahead = self.predicted[k + 1]
            gain = np.linalg.solve(ahead, self.ways[k] @ spread).T
            known_q, known_v, known = out[-1]
            moved = self.stepper.moved(qpos, qvel, gain @ self.stepper.difference(ahead_q, ahead_v, known_q, known_v))
            out.append((*moved, spread + gain @ (known - ahead) @ gain.T))
        positions, velocities, spreads = zip(*reversed(out), strict=True)
        return np.stack(positions), np.stack(velocities), np.stack(spreads)


def _gained(ways: Sequence[Array], held: Sequence[Array], measured: _Measured, period: float) -> Array:
    """Return `[2 nv]`, what a window without unknown forces tells of its start state, in what was known before.

    Args:
        held: of each row the constraints `[m, 2 nv]`, over their standard deviations.
    """
    size = len(ways[0])
    prior = np.repeat(PRIOR, size // 2)
    length = int(np.clip(round(CUTTING.window / period), 2, len(ways)))
    gained = []
    for first in np.linspace(0, len(ways) - length, 5).astype(int):
        way, information = np.eye(size), np.diag(prior**-2.0)
        for A, bound in zip(ways[first : first + length], held[first : first + length], strict=True):
            seen = np.concatenate([way[measured.rows] / measured.sigma[:, None], bound @ way])
            information = information + seen.T @ seen
            way = A @ way
        gained.append(prior**2 / np.diag(np.linalg.inv(information)) - 1)
    return np.asarray(np.max(gained, axis=0))


def _demand_axial(logs: Sequence[Log]) -> None:
    """Only hinges and slides are estimated.

    Where a robot floats, its joints do not show, and what it touches hangs on it. Of a ball joint under an arm of two
    hinges the filter stated 0.009 rad and was off by 0.3 rad: a turn about an upright limb hardly shows.

    Raises:
        UserError: naming one that is not.
    """
    for log in logs:
        for joint, kind in zip(log.joints, log.channels.kinds, strict=True):
            own = [f"qpos:{n}" for n in log.channels.of_joint(joint)]
            if kind in ("free", "ball") and set(own) & set(log.lost):
                raise UserError(
                    f"{log.name}: {kind} joint {joint!r} was not measured; allowed: all of {', '.join(own)} "
                    "(only hinges and slides are estimated)"
                )


def _demand(ways: Sequence[tuple[Log, Way]], model: mujoco.MjModel) -> None:
    """Every joint's velocity shows in what was measured; a position may be anywhere if it does not.

    Raises:
        UserError: naming those that do not.
    """
    log = ways[0][0]
    nv = model.nv
    known = np.max([way.known for _, way in ways], axis=0)
    names = [n for i, n in enumerate(log.channels.qvel) if known[nv + i] < 1]  # less than was known before
    if names:
        given = [f"qpos:{n}" for n in log.channels.qpos if f"qpos:{n}" not in log.absent]
        given += [f"qvel:{n}" for n, s in zip(log.channels.qvel, log.seen_speeds, strict=True) if s]
        raise UserError(
            f"{log.name}: the measurement ({', '.join(given)}) does not determine the motion of {', '.join(names)}; "
            "allowed: logs that measure these joints, or joints that they move"
        )


class Stepper:
    """Steps of a log: its commands through its controller, at the model's own step or a little less.

    States are (qpos `[nq]`, qvel `[nv]`); changes of them `[2 nv]` are in the tangent space.
    """

    def __init__(self, model: mujoco.MjModel, log: Log) -> None:
        self.model, self.log, self.nv = copy.copy(model), log, int(model.nv)
        self.data, self.longest = mujoco.MjData(self.model), float(model.opt.timestep)
        self.loops = Loops(self.model)  # with data of its own: the stepped one keeps its actuators
        declared = controllers.declared(log.metadata)
        source = str(log.metadata.get("source", log.name))
        law = controllers.read(log.metadata, model, log.actuators, source) if declared else None
        self.loop = None if law is None else DeclaredLaw(law)

    def reset(self) -> None:
        """Actuators without a past."""
        mujoco.mj_resetData(self.model, self.data)

    def advanced(self, qpos: Array, qvel: Array, row: int, span: float | None = None) -> tuple[Array, Array]:
        """Return the state at the next row, or `span` s later."""
        span = float(self.log.time[row + 1] - self.log.time[row]) if span is None else span
        steps = max(1, int(np.ceil(span / self.longest - 1e-6)))
        self.model.opt.timestep = span / steps
        command = self._at(qpos, qvel, row)
        for _ in range(steps):
            if self.loop is not None:
                self.data.ctrl[:] = self.loop(command, self.data.qpos, self.data.qvel)
            mujoco.mj_step(self.model, self.data)
        return self.data.qpos.copy(), self.data.qvel.copy()

    def _at(self, qpos: Array, qvel: Array, row: int) -> Array:
        """Return the command of a row; data in that state."""
        data, command = self.data, self.log.ctrl[row]
        if self.log.linear:
            command = 0.5 * (command + self.log.ctrl[row + 1])
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, qvel, 0.0
        data.ctrl[:] = command if self.loop is None else self.loop(command, data.qpos, data.qvel)
        return np.asarray(command)

    def bound(self, qpos: Array, qvel: Array, measured: _Measured) -> tuple[Array, Array, Array]:
        """Equality constraints at a state: (rows `[2 m, 2 nv]` of their derivatives, how far they are off, sd).

        A constraint holds as exactly as the encoders' noise moves it.
        """
        nv = self.nv
        J, off = self.loops.at(qpos)
        if not len(J):
            return np.zeros((0, 2 * nv)), np.zeros(0), np.zeros(0)
        noise = np.zeros(2 * nv)
        noise[measured.rows] = measured.sigma
        sd = np.maximum(np.concatenate([np.linalg.norm(J * n, axis=1) for n in (noise[:nv], noise[nv:])]), NUDGE)
        none = np.zeros_like(J)
        return np.block([[J, none], [none, J]]), np.concatenate([off, J @ qvel]), sd

    def linearised(self, qpos: Array, qvel: Array, row: int, span: float | None = None) -> tuple[Array, Array, Array]:
        """`advanced`, and its derivatives by the state `[2 nv, 2 nv]`."""
        before = self.data.act.copy()
        ends = self.advanced(qpos, qvel, row, span)
        after = self.data.act.copy()
        way = np.empty((2 * self.nv, 2 * self.nv))
        for i, nudge in enumerate(NUDGE * np.eye(2 * self.nv)):
            self.data.act[:] = before
            way[:, i] = self.difference(*ends, *self.advanced(*self.moved(qpos, qvel, nudge), row, span)) / NUDGE
        self.data.act[:] = after
        return *ends, way

    def accelerations(self, qpos: Array, qvel: Array, row: int) -> Array:
        """Return derivatives of the accelerations by the state `[nv, 2 nv]`."""

        def at(nudge: Array) -> Array:
            self._at(*self.moved(qpos, qvel, nudge), row)
            mujoco.mj_forward(self.model, self.data)
            return np.array(self.data.qacc)

        nudges = NUDGE * np.eye(2 * self.nv)
        return np.stack([(at(n) - at(-n)) / (2 * NUDGE) for n in nudges], 1)

    def moved(self, qpos: Array, qvel: Array, change: Array) -> tuple[Array, Array]:
        there = np.array(qpos)
        mujoco.mj_integratePos(self.model, there, change[: self.nv], 1.0)
        return there, qvel + change[self.nv :]

    def difference(self, qpos: Array, qvel: Array, to_qpos: Array, to_qvel: Array) -> Array:
        """Return the change `[2 nv]` from one state to another."""
        out = np.empty(2 * self.nv)
        mujoco.mj_differentiatePos(self.model, out[: self.nv], 1.0, qpos, to_qpos)
        out[self.nv :] = to_qvel - qvel
        return out
