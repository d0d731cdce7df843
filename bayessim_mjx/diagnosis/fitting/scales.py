"""How large forces, speeds and travel are at each place of this robot in these logs: what effects' ranges grow with."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from bayessim_mjx.compat import mass_matrix
from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import element_names, floating
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Log
from bayessim_mjx.parameters import Parameter, geometry
from bayessim_mjx.physics.loops import Loops

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """How large effects may be, from what the logs show. Rules of thumb, not counted."""

    large: float = 98.0  # percentile that counts as the largest
    load: float = 3.0  # times its own mass that a body may carry at least


LIMITS = Limits()


@dataclass(frozen=True)
class Scales:
    """Per dof `[nv]`: force [N m or N], speed, travel [rad or m], inertia; per actuator `[nu]`: command, effort.

    moves: `[nv]` bool, whether the joint moved by more than its noise at all; read: `[nv]` bool, whether anything reads
    the joint's encoder (a log, a servo or a declared controller); carried: `[nbody]`, kg that the robot can hold at
    each body; period: s between the logs' rows; loops: see `drives.loops_of`; follows: see `Loops.followers`.
    """

    model: mujoco.MjModel
    force: Array
    speed: Array
    travel: Array
    inertia: Array
    command: Array
    effort: Array
    moves: NDArray[np.bool_]
    read: NDArray[np.bool_]
    carried: Array
    period: float
    loops: Mapping[str, NDArray[np.bool_]]
    follows: Mapping[int, int] = field(default_factory=dict)

    def at(self, kind: str, place: str) -> dict[str, float]:
        """{word of `Quantity.per`: scale} at one place."""
        model = self.model
        if kind == "joint":
            return self._of_dof(int(model.jnt_dofadr[element_names(model, "joint").index(place)]))
        if kind == "actuator":
            i = element_names(model, "actuator").index(place)
            dof = drives.dof_of(model, i)
            own = {} if dof is None else self._of_dof(dof)
            if own:
                own["travel"] *= abs(float(model.actuator_gear[i, 0])) or 1.0  # of the actuator's own length
            return own | {"command": float(self.command[i]), "force": float(self.effort[i]), "period": self.period}
        if kind == "body":
            i = element_names(model, "body").index(place)
            gravity = float(np.linalg.norm(model.opt.gravity)) or 9.81
            below = float(model.body_subtreemass[i])
            mass = max(float(model.body_mass[i]), 0.1 * below)
            load = max(LIMITS.load * mass, float(self.carried[i]))
            own = {"mass": mass, "weight": below * gravity, "size": geometry.body_size(model, i)}
            own |= self._of_floating(int(model.body_dofadr[i])) if floating(model, i) else {}
            return own | {"carried": load, "tool": geometry.reach(model, i)}
        return {"moment": _moment(model)}

    def _of_floating(self, v: int) -> dict[str, float]:
        """Of a free joint's six degrees of freedom: the largest of three along, and of three about axes."""
        along, about = slice(v, v + 3), slice(v + 3, v + 6)
        parts = {"force": self.force[along], "speed": self.speed[along]}
        parts |= {"moment": self.force[about], "rate": self.speed[about]}
        return {word: float(np.max(part)) for word, part in parts.items()} | {"period": self.period}

    def _of_dof(self, v: int) -> dict[str, float]:
        words = ("force", "speed", "travel", "inertia")
        return {word: float(getattr(self, word)[v]) for word in words} | {"period": self.period}


def measure(model: mujoco.MjModel, logs: Sequence[Log], rating: Mapping[int, float] | None = None) -> Scales:
    """Scales from logs on an even grid; forces by inverse dynamics of the measured motion, and those of the drives.

    Args:
        rating: {body: kg} that the robot is rated to carry there.
    """
    speed = np.maximum(_large([log.qvel for log in logs]), 1e-6)
    ptp = np.max([_span(model, log) for log in logs], axis=0)
    command = _large([log.ctrl for log in logs])
    force, effort, inertia, places = _along(model, logs)
    groups = bound(model, [log.qpos[len(log) // 2] for log in logs])
    force = passed_on(force, speed, groups)
    for i in range(model.nu):
        if (dof := drives.dof_of(model, i)) is not None:
            effort[i] = max(effort[i], force[dof] / (abs(float(model.actuator_gear[i, 0])) or 1.0))
    noise = np.sqrt(np.mean([log.sigma_dofs**2 for log in logs], axis=0))
    loops = drives.loops_of(model, logs)
    read = read_by(model, logs, loops)
    return Scales(
        model=model,
        force=np.maximum(force, 1e-9),
        speed=speed,
        travel=np.maximum(ptp / 2, 1e-6),
        inertia=np.maximum(inertia, 1e-12),
        command=np.maximum(command, 1e-9),
        effort=np.maximum(effort, 1e-9),
        moves=ptp > 10 * noise + 1e-9,
        read=read,
        carried=drives.carried(model, places, rating),
        period=float(np.median([log.period for log in logs])),
        loops=loops,
        follows=Loops(model).followers(places, read),
    )


def _along(model: mujoco.MjModel, logs: Sequence[Log]) -> tuple[Array, Array, Array, Array]:
    """Return (forces `[nv]`, efforts of actuators `[nu]`, mean inertia `[nv]`, poses `[n, nq]`) along the logs.

    Forces are those that the motion needs, or the drives exert on it if that is more: what drag or friction holds at a
    steady speed needs none by a model without them. Loops are open: noise breaks them a little, and their stiff
    constraint would answer with forces far beyond those of the drives.
    """
    model = copy.copy(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    data = mujoco.MjData(model)
    needed, driven, effort, inertia, places = [], [], [], [], []
    integrates = model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
    for log in logs:
        ctrl, acceleration = drives.controlled(log, model), np.gradient(log.qvel, log.time, axis=0)
        for k in range(0, len(log), max(1, len(log) // 100)):
            places.append(log.qpos[k])
            data.qpos[:], data.qvel[:], data.qacc[:] = log.qpos[k], log.qvel[k], acceleration[k]
            mujoco.mj_inverse(model, data)
            needed.append(np.abs(data.qfrc_inverse))
            inertia.append(np.diag(mass_matrix(model, data)))
            data.ctrl[:] = ctrl[k]
            for i in np.flatnonzero(
                model.actuator_actadr >= 0
            ):  # at rest: a filter at its input, a target at the joint
                data.act[model.actuator_actadr[i]] = data.actuator_length[i] if integrates[i] else ctrl[k, i]
            mujoco.mj_fwdActuation(model, data)
            driven.append(np.abs(data.qfrc_actuator))
            effort.append(np.abs(data.actuator_force))
    force = np.maximum(_large([np.array(needed)]), _large([np.array(driven)]))
    return force, _large([np.array(effort)]), np.mean(inertia, axis=0), np.array(places)


def bound(model: mujoco.MjModel, poses: Sequence[Array]) -> NDArray[np.int64]:
    """`[nv]`, a number of the group of joints that equality constraints bind to each other in these poses `[nq]`."""
    together, loops = np.eye(model.nv, dtype=bool), Loops(model)
    for pose in poses if model.neq else ():
        J = loops.at(pose)[0] != 0
        together |= J.T @ J
    return np.asarray(connected_components(together)[1])


def passed_on(force: Array, speed: Array, groups: NDArray[np.int64]) -> Array:
    """Raise forces `[nv]` in a loop: the power at one of its joints may act at each of them, at its own speed."""
    power = np.zeros(len(force))
    np.maximum.at(power, groups, force * speed)
    return np.asarray(np.maximum(force, power[groups] / speed))


def read_by(model: mujoco.MjModel, logs: Sequence[Log], loops: Mapping[str, NDArray[np.bool_]]) -> NDArray[np.bool_]:
    """`[nv]`, whether a log, a servo or a declared controller reads the joint's encoder."""
    out = np.any([np.zeros(model.nv, bool), *(log.seen_dofs | log.seen_speeds for log in logs)], axis=0)
    servo = np.any(model.actuator_biasprm[:, 1:3] != 0, axis=1)
    for i in np.flatnonzero(servo | np.any([np.zeros(model.nu, bool), *loops.values()], axis=0)):
        if (dof := drives.dof_of(model, int(i))) is not None:
            out[dof] = True
    return np.asarray(out)


def _moment(model: mujoco.MjModel) -> float:
    """N m: what the robot weighs on its base when stretched out: masses times the lengths that carry them."""
    length = np.zeros(model.nbody)
    for b in range(1, model.nbody):
        length[b] = length[model.body_parentid[b]] + np.linalg.norm(model.body_pos[b]) * (model.body_parentid[b] > 0)
    arms = length[1:] + np.linalg.norm(model.body_ipos[1:], axis=1)
    gravity = float(np.linalg.norm(model.opt.gravity)) or 9.81
    return float(model.body_mass[1:] @ arms) * gravity or 1.0


def _large(parts: Sequence[Array]) -> Array:
    return np.percentile(np.abs(np.concatenate(parts)), LIMITS.large, axis=0) if parts[0].shape[1] else np.zeros(0)


def _span(model: mujoco.MjModel, log: Log) -> Array:
    """Range of motion per dof `[nv]`; orientations as rotation vectors from the first one."""
    away = np.zeros((len(log), model.nv))
    for row, qpos in zip(away, log.qpos, strict=True):
        mujoco.mj_differentiatePos(model, row, 1.0, log.qpos[0], qpos)
    return np.ptp(away, axis=0) if len(log) else np.zeros(model.nv)


def ranges(effect: type[Effect], place: str, scales: Scales) -> tuple[Parameter, ...]:
    """Return the effect's parameters at a place, with ranges that fit this robot.

    Raises:
        UserError: a quantity grows with something that its kind of place does not have.
    """
    here = scales.at(effect.kind, place)
    (block,) = effect(where=place).with_all().blocks()
    return tuple(_ranged(p, q, here, effect) for p, q in block.pairs())


def _ranged(p: Parameter, q: Quantity, here: dict[str, float], effect: type[Effect]) -> Parameter:
    if not q.per or q.reach is None:
        return p
    unit = _product(q.per, here, effect)
    low, high = (float(q.neutral + r * unit) if q.neutral == 0 else float(r * unit) for r in q.reach)
    low, high = (max(low, q.low), max(high, q.high)) if q.at_least else (low, high)
    nominal = min(max(q.neutral, low), high)
    low, high = (low, high) if low < high else (q.low, q.high)
    prior = q.prior if low > 0 else "uniform"
    return Parameter(
        p.name, nominal, low, high, unit=p.unit, prior=prior, attribute=p.attribute, target=p.target, kind="effect"
    )


def _product(expression: str, here: dict[str, float], effect: type[Effect]) -> float:
    """'force/speed^2' -> number."""
    value = 1.0
    for i, factor in enumerate(expression.split("/")):
        word, _, power = factor.strip().partition("^")
        if word in ("1", ""):
            continue
        if word not in here:
            raise UserError(
                f"{effect.name}: its range grows with {word!r}; this {effect.kind} has {', '.join(here) or 'none'}"
            )
        value *= here[word] ** ((-1 if i else 1) * float(power or 1))
    return value
