"""The columns that a measured effort may consist of, in one log: bodies, friction, springs, zeros, tilt.

Effort and columns pass the same zero-phase filter, so that a linear relation between them stays what it was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error import rigid
from bayessim_mjx.diagnosis.logcheck import channels
from bayessim_mjx.diagnosis.logcheck.drives import dof_of
from bayessim_mjx.diagnosis.logcheck.filtered_motion import Mask, Motion, bandwidth, filtered, lowpass, motion
from bayessim_mjx.diagnosis.logcheck.inverse_dynamics import recursive, springs
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
OWN = ("acceleration", "speed", "dry", "drag", "position", "one", "load", "effort_load")


@dataclass(frozen=True)
class Limits:
    """What is looked at."""

    slow: float = 0.02  # of a joint's top speed: where dry friction turns over
    shift: float = 1e-4  # rad or m, for the derivative by a joint's zero
    many: int = 16  # dofs, beyond which zeros of joints are not looked at


LIMITS = Limits()


@dataclass(frozen=True)
class Layout:
    """Where the columns stand: ten of each body, the joint's own (OWN), zeros [nv], drives, tilt, late, known, effort.

    shared: actuators that drive a joint together with others; each has a column of its own effort.
    """

    bodies: int
    nv: int
    shared: tuple[int, ...] = ()

    @property
    def size(self) -> int:
        return rigid.INERTIAL * self.bodies + len(OWN) + self.nv + len(self.shared) + 5

    def body(self, i: int) -> slice:
        return slice(rigid.INERTIAL * i, rigid.INERTIAL * (i + 1))

    def own(self, name: str) -> int:
        return rigid.INERTIAL * self.bodies + OWN.index(name)

    def zero(self, dof: int) -> int:
        return rigid.INERTIAL * self.bodies + len(OWN) + dof

    def drive(self, actuator: int) -> int:
        """Of one of the actuators `shared`."""
        return rigid.INERTIAL * self.bodies + len(OWN) + self.nv + self.shared.index(actuator)

    @property
    def tilt(self) -> slice:
        return slice(self.size - 5, self.size - 3)

    @property
    def late(self) -> int:
        return self.size - 3

    @property
    def known(self) -> int:
        """What the nominal model says."""
        return self.size - 2

    @property
    def effort(self) -> int:
        return self.size - 1


@dataclass(frozen=True, eq=False)
class Columns:
    """One log: x `[T, nv, size]`, rows `[nv, T]` to be used, and how many independent ones a row is."""

    x: Array
    rows: Mask
    share: float


def sources(log: Log, model: mujoco.MjModel) -> tuple[str, ...]:
    """Per dof: `effort` as measured, `ctrl` as commanded, `none` where nothing drives it, `` where it is not known."""
    dofs = [dof_of(model, i) for i in range(model.nu)]
    elsewhere = any(d is None for d in dofs)
    out = []
    for dof in range(model.nv):
        own = [i for i, d in enumerate(dofs) if d == dof]
        streams = [log.streams.get(f"effort:{log.actuators[i]}") for i in own]
        if not own:
            out.append("" if elsewhere else "none")
        elif all(s is not None and np.isfinite(s).all() for s in streams):
            out.append("effort")
        else:
            out.append("ctrl" if all(_known(model, i) for i in own) else "")
    return tuple(out)


def _known(model: mujoco.MjModel, i: int) -> bool:
    """Whether the actuator's force is a static law of command, position and speed."""
    fixed = int(model.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    affine = int(model.actuator_biastype[i]) <= int(mujoco.mjtBias.mjBIAS_AFFINE)
    return fixed and affine and int(model.actuator_dyntype[i]) == int(mujoco.mjtDyn.mjDYN_NONE)


def centred(log: Log) -> Log:
    """With commands at the middle of the time for which they hold."""
    middle = log.time + 0.5 * np.append(np.diff(log.time), log.period)
    ctrl = np.stack([np.interp(log.time, middle, c) for c in log.ctrl.T], 1) if log.ctrl.shape[1] else log.ctrl
    return replace(log, ctrl=ctrl)


def asked(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nv]`, generalised force that the commands ask for."""
    return _on_dofs(asked_of(centred(log), model), model)


def asked_of(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nu]`, forces of the actuators for the log's commands, through the law that it declares."""
    own = replace(log, ctrl=channels.through_law(log, model)) if channels.declared(log) else log
    return channels.forces(own, model)


def layout_of(model: mujoco.MjModel) -> Layout:
    """The columns of a model."""
    dofs = [dof_of(model, i) for i in range(model.nu)]
    shared = tuple(i for i, dof in enumerate(dofs) if dof is not None and dofs.count(dof) > 1)
    return Layout(len(rigid.moving_bodies(model)), model.nv, shared)


def measured(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nv]`, generalised force as the drives measured it; 0 where they did not."""
    return _on_dofs(measured_of(log, model), model)


def measured_of(log: Log, model: mujoco.MjModel) -> Array:
    """`[T, nu]`, forces of the actuators as they were measured; 0 where they were not."""
    out = np.zeros((len(log), model.nu))
    for i, name in enumerate(log.actuators):
        stream = log.streams.get(f"effort:{name}")
        if stream is not None and np.isfinite(stream).all():
            out[:, i] = stream
    return out


def _on_dofs(force: Array, model: mujoco.MjModel) -> Array:
    out = np.zeros((len(force), model.nv))
    for i in range(model.nu):
        dof = dof_of(model, i)
        if dof is not None:
            out[:, dof] += model.actuator_gear[i, 0] * force[:, i]
    return out


def columns(log: Log, model: mujoco.MjModel, source: tuple[str, ...], slow: Array) -> Columns:
    """All columns of one log.

    Args:
        source: `[nv]`, see `sources`; slow: `[nv]`, speeds at which dry friction turns over.
    """
    moved = motion(log, model, bandwidth(log))
    frames = rigid.Frames.of(model, moved)
    layout = layout_of(model)
    x = np.zeros((len(moved.time), model.nv, layout.size))
    body = frames.columns()
    for i in range(layout.bodies):
        x[:, :, layout.body(i)] = body[:, i]
    nominal = np.einsum("tbvk,bk->tv", body, rigid.nominal(model))
    for k, axis in enumerate(np.eye(3)[:2]):
        fall = frames.tilted(-np.cross(axis, model.opt.gravity))
        x[:, :, layout.tilt.start + k] = np.einsum("tbvk,bk->tv", fall, rigid.nominal(model))
    effort = np.where(np.array(source) == "effort", measured(log, model), asked(log, model))
    y = np.stack([filtered(effort[:, v], log, moved) for v in range(model.nv)], 1)
    held = springs(model, moved)
    _own(x, layout, moved, slow, y, frames.bias + held)
    x[:, :, layout.known] = nominal + held + model.dof_damping * moved.qvel + model.dof_armature * moved.qacc
    x[:, :, layout.known] += model.dof_frictionloss * np.tanh(moved.qvel / slow)
    if model.nv <= LIMITS.many:
        _zeros(x, layout, model, moved)
    x = lowpass(x, moved.step, moved.cutoff)
    x[:, :, layout.effort] = y  # filtered before
    forces = {"effort": measured_of, "ctrl": lambda log, model: asked_of(centred(log), model)} if layout.shared else {}
    of = {name: force(log, model) for name, force in forces.items()}
    for i in layout.shared:
        v = dof_of(model, i)
        if v is not None and source[v] in of:
            own = model.actuator_gear[i, 0] * of[source[v]][:, i]
            x[:, v, layout.drive(i)] = filtered(own, log, moved)
    x[:, :, layout.late] = np.gradient(y, moved.step, axis=0)
    rows = np.stack([moved.moving(v) & (source[v] != "") for v in range(model.nv)])
    return Columns(x, rows, min(1.0, 2.0 * moved.cutoff * moved.step))


def _own(x: Array, layout: Layout, moved: Motion, slow: Array, y: Array, load: Array) -> None:
    """The columns of a joint's own motion, in place."""
    v = moved.qvel
    dry = np.tanh(v / slow)
    travel = np.zeros_like(v) + np.cumsum(v, 0) * moved.step
    own = {
        "acceleration": moved.qacc, "speed": v, "dry": dry, "drag": v * np.abs(v), "position": travel,
        "one": np.ones_like(v), "load": np.abs(load) * dry, "effort_load": np.abs(y) * dry,
    }  # fmt: skip
    for name, column in own.items():
        x[:, :, layout.own(name)] = column


def _zeros(x: Array, layout: Layout, model: mujoco.MjModel, moved: Motion) -> None:
    """Derivatives of the nominal effort by each joint's zero, in place; and positions as they are, where they are."""
    for joint in np.flatnonzero(model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)):
        q, v = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        x[:, v, layout.own("position")] = moved.qpos[:, q]
        ends = []
        for sign in (1, -1):
            qpos = moved.qpos.copy()
            qpos[:, q] += sign * LIMITS.shift
            ends.append(recursive(model, replace(moved, qpos=qpos)))
        x[:, :, layout.zero(v)] = (ends[0] - ends[1]) / (2 * LIMITS.shift)
