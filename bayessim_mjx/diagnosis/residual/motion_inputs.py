"""What a missing force may depend on, per control step of every window, from the measured motion alone."""

from __future__ import annotations

from collections.abc import Sequence
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


# Random features for each joint: neurons of a hidden layer that is drawn and not trained (Rahimi and Recht, 2008). A
# rule of thumb, not counted: no verdict rests on it
NEURONS = 24
# no measured acceleration: with effort and pose it *is* the residual of inverse dynamics, noise included, so that a
# force that depends on it explains everything, held out or not
QUANTITIES = ("position", "speed", "direction", "stop", "load", "effort", "past", "pull", "since_reversal", "time")
PLAIN = ("position", "speed", "direction", "effort", "past")  # without physics
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
        stop: how far a small spring that slips at a fixed travel is wound, -1..1.
        load: force that holds the measured pose; effort: of the actuators, both N m or N.
        past: effort a control step ago minus effort now.
        pull: acceleration that the model expects in the measured state under this effort.
        since_reversal: s; time: s in the log.
        joints: name per dof; hinge: `[nv]` bool, whether it turns.
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

    def of(self, name: str) -> Array:
        """`[W, H, nv]`, the quantity of this name."""
        return np.asarray(getattr(self, name))

    @property
    def force_unit(self) -> tuple[str, ...]:
        """Of each dof."""
        return tuple("N m" if h else "N" for h in self.hinge)

    @property
    def angle_unit(self) -> tuple[str, ...]:
        """Of each dof's position."""
        return tuple("rad" if h else "m" for h in self.hinge)


def measured(windows: Windows, model: mujoco.MjModel) -> Inputs:
    """Make the inputs of all windows.

    Args:
        windows: from `windows.cut`; model: the nominal one, for gravity loads and efforts.
    """
    per_log = [_of_log(log, r, windows, model) for r, log in enumerate(windows.logs)]

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
    return Inputs(**{name: cut(name) for name in QUANTITIES}, joints=tuple(joints), hinge=hinge)


def _of_log(log: Log, index: int, windows: Windows, model: mujoco.MjModel) -> dict[str, Array]:
    position = _positions(log, model)
    # noise alone hardly goes beyond sqrt(2 log n) standard deviations in n rows (Donoho and Johnstone, 1994)
    noise = np.nan_to_num(log.sigma_qvel) * np.sqrt(2 * np.log(len(log)))
    direction, since = _direction(log.qvel, noise, windows.dt)
    # presliding lies between the noise and the range of motion: their geometric mean
    width = np.sqrt(np.maximum(np.nan_to_num(windows.sigma_q), 1e-9) * np.maximum(np.ptp(position, axis=0), 1e-9))
    load, effort, pull = _forces(log, model, windows, index)
    return {
        "position": position,
        "speed": log.qvel,
        "direction": direction,
        "stop": _wound(position, width),
        "load": load,
        "effort": effort,
        "past": np.concatenate([0 * effort[:1], effort[:-1] - effort[1:]]),
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


def laws(inputs: Inputs) -> dict[str, Array]:
    """{name: `[W, H, nv]`}, of the joint itself in rad or m, rad/s or m/s, N m or N."""
    q, w, u, sign = inputs.position, inputs.speed, inputs.effort, inputs.direction
    return {
        "1": np.ones_like(q), "q": q, "q^2": q**2, "q^3": q**3, "sin q": np.sin(q), "cos q": np.cos(q),
        "w": w, "sign w": sign, "w |w|": w * np.abs(w), "u": u, "|u|": np.abs(u), "u |u|": u * np.abs(u),
        "|u| sign w": np.abs(u) * sign, "q w": q * w, "q u": q * u, "u w": u * w, "q sign w": q * sign,
    }  # fmt: skip


def _of_others(values: Array) -> Array:
    """`[W, H, nv, nv - 1]`, the values of all other joints, in their order."""
    return np.stack([np.delete(values, v, 2) for v in range(values.shape[2])], 2)


def plain(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: laws of positions, speeds and efforts of the joint, and those of all others."""
    others = [_of_others(x) for x in (inputs.position, inputs.speed, inputs.effort)]
    return np.concatenate([np.stack(list(laws(inputs).values()), 3), *others], 3)


def named(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: what effects depend on besides."""
    s, load, time = inputs.direction, inputs.load, inputs.time
    smooth = np.tanh(inputs.speed / np.maximum(inputs.speed.std((0, 1)), 1e-300))
    own = [
        smooth, np.sin(inputs.position) * s, np.cos(inputs.position) * s, load, np.abs(load) * s, inputs.pull,
        inputs.past, inputs.stop, inputs.since_reversal * s, time, time * s, time * inputs.effort,
    ]  # fmt: skip
    return np.concatenate([np.stack(own, 3), _of_others(inputs.direction)], 3)


class Features:
    """Inputs -> features at the nodes, `[W, m, nv, F]`, in standard deviations of the logs; the first one is 1.

    Args:
        inputs: of these logs; average: `[H, m]`; quantities: that the random features read; seed: of these.
        physics: whether there are features that effects depend on.
    """

    def __init__(self, inputs: Inputs, average: Array, quantities: Sequence[str], seed: int, physics: bool) -> None:
        self.average, self.quantities, self.physics = average, quantities, physics
        rng, nv, each = np.random.default_rng(seed), len(inputs.joints), len(quantities)
        other = rng.integers(0, nv, (nv, NEURONS))
        reads = (np.arange(nv) == np.arange(nv)[:, None, None]) | (np.arange(nv) == other[..., None])
        kept = reads[..., None] & (rng.random((nv, NEURONS, nv, each)) < 1 / 2)
        self.weights, self.shifts = kept * rng.normal(size=kept.shape), rng.normal(size=(nv, NEURONS))
        z = self._read(inputs)
        self.z_moments = z.mean((0, 1)), _spread(z)
        raw = self._raw(inputs)
        self.moments = raw.mean((0, 1)), _spread(raw)

    def _read(self, inputs: Inputs) -> Array:
        return np.stack([inputs.of(q) for q in self.quantities], 3)

    def _raw(self, inputs: Inputs) -> Array:
        z = (self._read(inputs) - self.z_moments[0]) / self.z_moments[1]
        hidden = np.tanh(np.einsum("whuq,vfuq->whvf", z, self.weights, optimize=True) + self.shifts)
        parts = [plain(inputs), named(inputs), hidden] if self.physics else [z, hidden]
        return np.einsum("hm,whvf->wmvf", self.average, np.concatenate(parts, 3), optimize=True)

    def __call__(self, inputs: Inputs) -> Array:
        phi = (self._raw(inputs) - self.moments[0]) / self.moments[1]
        return np.concatenate([np.ones((*phi.shape[:3], 1)), phi], 3)


def _spread(values: Array) -> Array:
    """Return standard deviations over windows and steps, infinite of what does not change."""
    sd = values.std((0, 1))
    return np.where(sd > np.finfo(np.float32).eps * np.abs(values).max((0, 1)), sd, np.inf)
