"""The drives: how each is commanded, the force that it should exert for a command, or did, and what they can carry."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.support.actuators import OfGains
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.parameters.geometry import tree_mass
from bayessim_mjx.physics import controllers

# Of a joint's root mean square effort: so much filters and derivatives are worth. A choice, not counted.
FLOOR = 0.01
# Share that counts as nothing, three of these standard deviations: of an effort, rms (an effect, a constant, what is
# unexplained), of a drive's scale, of a joint's top speed, of a log's rows. Error rates: benchmarks/records/.
LEAST = 3.0 * FLOOR
_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_NO_MEMORY = tuple(int(getattr(mujoco.mjtDyn, f"mjDYN_{n}")) for n in ("NONE", "FILTER", "FILTEREXACT"))


def is_effort(mj_model: mujoco.MjModel, actuator: int) -> bool:
    """Whether this actuator's ctrl is a force up to a gain (motor, voltage), not the target of a servo."""
    bias = mj_model.actuator_biasprm[actuator, 1] if mj_model.actuator_biastype[actuator] else 0.0
    fixed = mj_model.actuator_gaintype[actuator] == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = mj_model.actuator_biastype[actuator] <= int(mujoco.mjtBias.mjBIAS_AFFINE)
    return bool(fixed and affine and bias == 0.0 and mj_model.actuator_dyntype[actuator] in _NO_MEMORY)


def dof_of(mj_model: mujoco.MjModel, actuator: int) -> int | None:
    """Return the degree of freedom of the hinge or slide joint of an actuator; None for tendons, sites, balls."""
    if mj_model.actuator_trntype[actuator] not in _JOINT:
        return None
    joint = mj_model.actuator_trnid[actuator, 0]
    axial = mj_model.jnt_type[joint] >= int(mujoco.mjtJoint.mjJNT_SLIDE)
    return int(mj_model.jnt_dofadr[joint]) if axial else None


def on_dofs(force: Array, model: mujoco.MjModel) -> Array:
    """`[T, nu]` forces of actuators -> `[T, nv]` generalised forces of those on hinges and slides."""
    out = np.zeros((len(force), model.nv))
    for i in range(model.nu):
        dof = dof_of(model, i)
        if dof is not None:
            out[:, dof] += model.actuator_gear[i, 0] * force[:, i]
    return out


class DeclaredLaw:
    """The controller that a log declares, on plain arrays: command `[..., nu]`, qpos, qvel -> ctrl `[..., nu]`."""

    def __init__(self, law: controllers.Law) -> None:
        fields = ("on_position", "on_velocity", "kp", "kd", "limit", "scale")
        self.numbers = tuple(np.asarray(getattr(law, name), float) for name in fields)
        self.q, self.v = list(law.qadr), list(law.dadr)

    def __call__(self, command: Array, qpos: Array, qvel: Array) -> Array:
        on_position, on_velocity, kp, kd, limit, scale = self.numbers
        q, w = qpos[..., self.q], qvel[..., self.v]
        loop = np.where(on_position > 0, kp * (command - q) - kd * w, kp * (command - w)) * scale
        return np.where(on_position + on_velocity > 0, np.clip(loop, -limit, limit), command * scale)


def commanded(log: Log, model: mujoco.MjModel, law: controllers.Law | None = None) -> Array:
    """`[T, nu]`, forces that the commands ask of the actuators before the gear, through the law that the log declares.

    Without a declared law the commands are ctrl. Forces are those of the model: f = gain u + b0 + b1 l + b2 dl/dt.
    law: another than the declared one.
    """
    out = controlled(log, model) if law is None else DeclaredLaw(law)(log.ctrl, log.qpos, log.qvel)
    for i in range(model.nu):
        dof = dof_of(model, i)
        gear, gain, bias = model.actuator_gear[i, 0], model.actuator_gainprm[i, 0], model.actuator_biasprm[i]
        ctrl = np.clip(out[:, i], *model.actuator_ctrlrange[i]) if model.actuator_ctrllimited[i] else out[:, i]
        out[:, i] = gain * ctrl
        if dof is not None and model.actuator_biastype[i] == int(mujoco.mjtBias.mjBIAS_AFFINE):
            length = gear * log.qpos[:, int(model.jnt_qposadr[model.dof_jntid[dof]])]
            out[:, i] += bias[0] + bias[1] * length + bias[2] * gear * log.qvel[:, dof]
        if model.actuator_forcelimited[i]:
            out[:, i] = np.clip(out[:, i], *model.actuator_forcerange[i])
    return out


def by_gain(
    log: Log, model: mujoco.MjModel, kind: type[Effect], actuator: int, force: Array, factors: Sequence[float]
) -> Iterator[Array]:
    """`[T]` of each of `factors`: (force with that multiple of a gain - force) / (multiple - 1).

    Without a force limit all are the same.
    """
    log, law = centred(log), controllers.read(log.metadata, model, log.actuators, log.name)
    for factor in factors:
        if issubclass(kind, OfGains):
            moved = commanded(log, kind.scaled(model, actuator, factor))
        else:
            gains = getattr(law, kind.loop).at[actuator].multiply(factor)
            moved = commanded(log, model, law.replace(**{kind.loop: gains}))
        yield (moved[:, actuator] - force) / (factor - 1.0)


def controlled(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nu]`, ctrl that the declared law makes of the commands; without one the commands themselves (a copy)."""
    if not controllers.declared(log.metadata):
        return log.ctrl.astype(float)
    return DeclaredLaw(controllers.read(log.metadata, model, log.actuators, log.name))(log.ctrl, log.qpos, log.qvel)


def loops_of(model: mujoco.MjModel, logs: Sequence[Log]) -> dict[str, np.ndarray]:
    """{kp, kd: `[nu]` bool, whether a log declares a controller there that has this gain}."""
    law = controllers.of_logs(logs, model)
    if law is None:
        return dict.fromkeys(("kp", "kd"), np.zeros(model.nu, bool))
    return {gain: np.any(np.asarray(getattr(law, gain)) > 0, axis=0) for gain in ("kp", "kd")}


def measured(log: Log, actuator: int) -> Array | None:
    """`[T]`, force of one actuator as it was logged, before the gear; None: not in every row."""
    stream = log.streams.get(f"effort:{log.actuators[actuator]}")
    return None if stream is None or not np.isfinite(stream).all() else np.asarray(stream)


def measured_forces(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nu]`, forces of the actuators as they were logged; 0 where they were not."""
    each = [measured(log, i) for i in range(model.nu)]
    return np.stack([np.zeros(len(log)) if x is None else x for x in each], 1) if each else np.zeros((len(log), 0))


def centred(log: Log) -> Log:
    """With commands at the middle of the time for which they hold."""
    middle = log.time + 0.5 * np.append(np.diff(log.time), log.period)
    ctrl = np.stack([np.interp(log.time, middle, c) for c in log.ctrl.T], 1) if log.ctrl.shape[1] else log.ctrl
    return replace(log, ctrl=ctrl)


def looped(log: Log) -> bool:
    """Whether a position or velocity loop stands between the logged command and the actuator."""
    given = log.metadata.get("controller")
    blocks = [given, *given.values()] if isinstance(given, dict) else []
    named = [str(b.get("law", "direct")).lower() for b in blocks if isinstance(b, dict)]
    return any(controllers.ALIASES.get(n, "direct") != "direct" for n in named)


@dataclass(frozen=True, eq=False)
class Effort:
    """What drove one joint: signal [T of the log], in the model's unit (N m, N) where `scaled`.

    hold: s that it acts after its rows' stamps on average: half a row, of commands that hold until the next.
    """

    joint: str
    dof: int
    source: str  # ctrl or effort
    signal: Array
    scaled: bool
    hold: float = 0.0


def efforts(log: Log, model: mujoco.MjModel) -> Iterator[Effort]:
    """Return the efforts of every joint whose drives are all known: from the `effort:` streams, and from ctrl."""
    dofs = [dof_of(model, i) for i in range(model.nu)]
    shown = on_dofs(measured_forces(log, model), model)
    asked = None if looped(log) else on_dofs(commanded(log, model), model)
    for dof in sorted({d for d in dofs if d is not None}):
        own = [i for i, d in enumerate(dofs) if d == dof]
        joint = log.joints[int(model.dof_jntid[dof])]
        if all(measured(log, i) is not None for i in own):
            yield Effort(joint, dof, "effort", shown[:, dof], False)
        if asked is not None and all(is_effort(model, i) for i in own):
            yield Effort(joint, dof, "ctrl", asked[:, dof], True, 0.0 if log.linear else 0.5 * log.period)


# What the drives can carry, and how far out: the scale of an unknown payload


def carried(model: mujoco.MjModel, places: Array, rating: Mapping[int, float] | None = None) -> Array:
    """kg that may be on each body `[nbody]`: as rated, else as the drives hold at rest in all of some places.

    At every joint m g lever <= force limit + own gravity torque, which the load may balance; at most the robot's own
    weight. Joints without a drive hold nothing and rule nothing out; nor do drives without a limit.

    Args:
        places: `[T, nq]`, positions that were logged; rating: {body: kg}, of a data sheet.
    """
    limit = force_limits(model)
    out = np.array([tree_mass(model, b) for b in range(model.nbody)])
    data, jacobian = mujoco.MjData(model), np.zeros((3, model.nv))
    for qpos in places if np.isfinite(limit).any() else ():
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        room = limit + np.abs(data.qfrc_bias)
        for body in np.flatnonzero(model.body_weldid):
            mujoco.mj_jacBodyCom(model, data, jacobian, None, int(body))
            torque = np.abs(model.opt.gravity @ jacobian)  # N m per kg
            out[body] = np.min(room[torque > 0] / torque[torque > 0], initial=out[body])
    for stated, mass in (rating or {}).items():
        out[stated] = mass
    return out


def force_limits(model: mujoco.MjModel) -> Array:
    """Largest generalised force of the drives `[nv]`, N m or N; infinite where no limit is set or nothing drives."""
    limit = np.zeros(model.nv)
    for i in range(model.nu):
        dof = dof_of(model, i)
        if dof is not None:
            limit[dof] += abs(float(model.actuator_gear[i, 0])) * _largest(model, i)
    limit[limit == 0] = np.inf
    for j in np.flatnonzero(model.jnt_actfrclimited):
        v = int(model.jnt_dofadr[j])
        limit[v] = min(limit[v], float(np.abs(model.jnt_actfrcrange[j]).max()))
    return limit


def _largest(model: mujoco.MjModel, actuator: int) -> float:
    """Largest force of one actuator by its force range, or by its command's where the command is a force."""
    ends = []
    if model.actuator_forcelimited[actuator]:
        ends.append(float(np.abs(model.actuator_forcerange[actuator]).max()))
    if is_effort(model, actuator) and model.actuator_ctrllimited[actuator]:
        largest = float(np.abs(model.actuator_ctrlrange[actuator]).max())
        ends.append(largest * abs(float(model.actuator_gainprm[actuator, 0])))
    return min(ends, default=np.inf)


def sources(logs: Sequence[Log], model: mujoco.MjModel) -> tuple[str, ...]:
    """Per dof, in all logs: `effort` as measured, `ctrl` as commanded, `none`: nothing drives it, ``: not known."""
    each = [set(of) for of in zip(*(_sources(log, model) for log in logs), strict=True)]
    return tuple(of.pop() if len(of) == 1 else "ctrl" if of == {"ctrl", "effort"} else "" for of in each)


def _sources(log: Log, model: mujoco.MjModel) -> list[str]:
    dofs = [dof_of(model, i) for i in range(model.nu)]
    elsewhere = any(d is None for d in dofs)
    out = []
    for dof in range(model.nv):
        own = [i for i, d in enumerate(dofs) if d == dof]
        if not own:
            out.append("" if elsewhere else "none")
        elif all(measured(log, i) is not None for i in own):
            out.append("effort")
        else:
            out.append("ctrl" if all(_static(model, i) for i in own) else "")
    return out


def _static(model: mujoco.MjModel, i: int) -> bool:
    """Whether the actuator's force is a static law of command, position and speed."""
    fixed = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[i]) <= int(mujoco.mjtBias.mjBIAS_AFFINE)
    return fixed and affine and int(model.actuator_dyntype[i]) == int(mujoco.mjtDyn.mjDYN_NONE)
