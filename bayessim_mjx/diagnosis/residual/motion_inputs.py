"""What a missing force may depend on, per control step of every window, from the measured motion alone."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
_AXIAL = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))


@dataclass(frozen=True)
class Sizes:
    """What counts as moving, and how far back inputs reach. Rules of thumb, not counted.

    Attributes:
        moving: of the speed scale, ends of the speed below which a joint has no direction of its own; in between three
            standard deviations of the noise.
        lags: control steps of past effort.
    """

    moving: tuple[float, float] = (0.003, 0.03)
    lags: tuple[int, int] = (1, 3)


SIZES = Sizes()
# no measured acceleration: with effort and pose it *is* the residual of inverse dynamics, noise included, so that a
# force that depends on it explains everything, held out or not
QUANTITIES = ("position", "speed", "direction", "stop", "load", "effort", "past", "pull", "since_reversal", "time")
WORDS = {
    "position": "position", "speed": "speed", "direction": "direction of motion",
    "stop": "micro-motion after reversals",
    "load": "gravity load", "effort": "effort", "past": "past effort", "pull": "expected acceleration",
    "since_reversal": "time since reversal", "time": "time",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Inputs:
    """Measured quantities, `[W, H, nv]` each, at the middle of each control step.

    Attributes:
        position: rad or m (zero for dofs of free and ball joints); speed.
        direction: sign of the last motion that was more than noise.
        stop: `[W, H, nv, 2]`, how far a small spring that slips at a fixed travel is wound, -1..1 (two travels).
        load: force that holds the measured pose; effort: of the actuators, both N m or N.
        past: `[W, H, nv, 2]`, effort some control steps ago minus effort now.
        pull: acceleration that the model expects in the measured state under this effort.
        since_reversal: s; time: s in the log.
        joints: name per dof; hinge: `[nv]` bool, whether it turns; *_scale: `[nv]`, large values.
    """

    position: Array
    speed: Array
    direction: Array
    stop: Array
    load: Array
    effort: Array
    past: Array
    pull: Array
    since_reversal: Array
    time: Array
    joints: tuple[str, ...]
    hinge: NDArray[np.bool_]
    speed_scale: Array
    load_scale: Array
    effort_scale: Array

    def of(self, name: str) -> Array:
        return np.asarray(getattr(self, name))

    @property
    def force_unit(self) -> tuple[str, ...]:
        return tuple("N m" if h else "N" for h in self.hinge)

    @property
    def angle_unit(self) -> tuple[str, ...]:
        return tuple("rad" if h else "m" for h in self.hinge)


def measured(windows: Windows, model: mujoco.MjModel) -> Inputs:
    """Inputs of all windows.

    Args:
        windows: from `windows.cut`; model: the nominal one, for gravity loads and efforts.
    """
    speed_scale = np.percentile(np.abs(np.concatenate([log.qvel for log in windows.logs])), 98, axis=0)
    speed_scale = np.maximum(speed_scale, 1e-9)
    per_log = [_of_log(log, r, windows, model, speed_scale) for r, log in enumerate(windows.logs)]

    def cut(name: str) -> Array:
        rows = [per_log[r][name][a : a + windows.steps + 1] for r, a in zip(windows.log, windows.start, strict=True)]
        ends = np.stack(rows)
        return 0.5 * (ends[:, 1:] + ends[:, :-1])

    hinge = np.ones(model.nv, bool)
    joints = [model.joint(int(model.dof_jntid[v])).name or f"joint{int(model.dof_jntid[v])}" for v in range(model.nv)]
    for v in range(model.nv):
        joint = int(model.dof_jntid[v])
        kind, first = int(model.jnt_type[joint]), int(model.jnt_dofadr[joint])
        hinge[v] = kind != _AXIAL[0] and not (kind == 0 and v - first < 3)
        if kind not in _AXIAL:
            joints[v] = f"{joints[v]}[{v - first}]"
    values = {name: cut(name) for name in QUANTITIES}
    return Inputs(
        **values,
        joints=tuple(joints),
        hinge=hinge,
        speed_scale=speed_scale,
        load_scale=_scale(values["load"]),
        effort_scale=_scale(values["effort"]),
    )


def _scale(values: Array) -> Array:
    return np.maximum(np.percentile(np.abs(values), 98, axis=(0, 1)), 1e-12)


def _of_log(log: Log, index: int, windows: Windows, model: mujoco.MjModel, speed_scale: Array) -> dict[str, Array]:
    position = _positions(log, model)
    slow = np.clip(3 * log.sigma_qvel, SIZES.moving[0] * speed_scale, SIZES.moving[1] * speed_scale)
    direction, since = _direction(log.qvel, slow, windows.dt)
    travel = np.maximum(np.ptp(position, axis=0), 1e-9)
    widths = [np.maximum(f * travel, 4 * windows.sigma_q) for f in (0.01, 0.05)]
    load, effort, pull = _forces(log, model, windows, index)
    past = [np.concatenate([effort[:lag] * 0, effort[:-lag] - effort[lag:]]) for lag in SIZES.lags]
    return {
        "position": position,
        "speed": log.qvel,
        "direction": direction,
        "stop": np.stack([_wound(position, width) for width in widths], 2),
        "load": load,
        "effort": effort,
        "past": np.stack(past, 2),
        "pull": pull,
        "since_reversal": since,
        "time": np.repeat((log.time - log.time[0])[:, None], model.nv, 1),
    }


def _positions(log: Log, model: mujoco.MjModel) -> Array:
    out = np.zeros((len(log), model.nv))
    for j in range(model.njnt):
        if int(model.jnt_type[j]) in _AXIAL:
            out[:, model.jnt_dofadr[j]] = log.qpos[:, model.jnt_qposadr[j]]
    return out


def _direction(speed: Array, threshold: Array, dt: float) -> tuple[Array, Array]:
    """(sign of the last clear motion, from where the speed crossed zero; seconds since it changed), `[T, nv]`."""
    direction, since = np.zeros_like(speed), np.zeros_like(speed)
    for v in range(speed.shape[1]):
        sign, clear = np.sign(speed[:, v]), np.abs(speed[:, v]) > threshold[v]
        if not clear.any():
            continue
        state, start = sign[np.argmax(clear)], 0
        for t in range(len(sign)):
            if clear[t] and sign[t] != state:
                state, start = sign[t], t
                while start > 0 and sign[start - 1] == state:
                    start -= 1
                direction[start:t, v] = state
                since[start:t, v] = dt * np.arange(t - start)
            direction[t, v], since[t, v] = state, dt * (t - start)
    return direction, since


def _wound(position: Array, width: Array) -> Array:
    """Stop operator: follows the position and slips at +-width; in units of the width."""
    out, state = np.zeros_like(position), np.zeros(position.shape[1])
    for t in range(1, len(position)):
        state = np.clip(state + position[t] - position[t - 1], -width, width)
        out[t] = state / width
    return out


def _forces(log: Log, model: mujoco.MjModel, windows: Windows, index: int) -> tuple[Array, Array, Array]:
    """(force that holds the measured pose, actuators' generalised force, expected acceleration) `[T, nv]`."""
    data = mujoco.MjData(model)
    control = _control(log, windows, index)
    load, effort, pull = (np.zeros((len(log), model.nv)) for _ in range(3))
    for t in range(len(log)):
        data.qpos[:], data.qvel[:], data.qacc[:] = log.qpos[t], 0.0, 0.0
        mujoco.mj_inverse(model, data)
        load[t] = data.qfrc_inverse
        data.qvel[:], data.ctrl[:] = log.qvel[t], control[t]
        mujoco.mj_forward(model, data)
        effort[t], pull[t] = data.qfrc_actuator, data.qacc
    for i, name in enumerate(log.actuators):  # what a drive says is better than what we compute, whatever its unit
        stream = log.streams.get(f"effort:{name}")
        if stream is not None and int(model.actuator_trntype[i]) <= int(mujoco.mjtTrn.mjTRN_JOINTINPARENT):
            effort[:, model.jnt_dofadr[int(model.actuator_trnid[i, 0])]] = np.nan_to_num(stream)
    effort[~log.enabled] = 0.0
    return load, effort, pull


def _control(log: Log, windows: Windows, index: int) -> Array:
    """Commands after the controller that the log declares."""
    law = windows.batch.law
    if law is None or index not in windows.log:
        return log.ctrl
    own = jax.tree.map(lambda x: x[int(np.argmax(windows.log == index))], law)
    out = jax.vmap(own)(jnp.asarray(log.ctrl), jnp.asarray(log.qpos), jnp.asarray(log.qvel))
    return np.asarray(out, np.float64)
