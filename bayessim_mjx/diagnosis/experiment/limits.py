"""What a robot may do, how its drives are made to do it, and a menu of motions that excite one joint, or all.

Limits are the model's or given ones, else a little more than the logs already did. A joint that is driven by a torque
gets a loop around it, as far as the control period allows.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.robot import AXIAL
from bayessim_mjx.diagnosis.logcheck.drives import commanded, dof_of
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Channels, Log
from bayessim_mjx.parameters.attributes import suggest

BEYOND = 1.1  # of what the logs already did, where nothing else is said; rule of thumb
BANDWIDTH = 12.0  # rad/s, of the loop around a torque-driven joint; rule of thumb
_KEYS = {"joints": ("range", "speed"), "actuators": ("command", "effort")}


@dataclass(frozen=True, eq=False)
class Limits:
    """What must not be left.

    Attributes:
        low, high, speed: `[nv]`, rad or m, and per s; infinite where nothing limits (what nothing drives, bases).
        command_low, command_high: `[nu]`, units of ctrl; effort: `[nu]`, largest |force| of the actuator.
        source: {joint or actuator: where the limits come from}.
    """

    low: Array
    high: Array
    speed: Array
    command_low: Array
    command_high: Array
    effort: Array
    source: dict[str, str]


def limits_of(model: mujoco.MjModel, logs: Sequence[Log], given: Mapping[str, Any] | None = None) -> Limits:
    """Ranges of the model where it has some, else 110 % of what the logs did; `given` has the last word.

    Args:
        given: {"joints": {name: {"range": [low, high], "speed": v}}, "actuators": {name: {"command": [low, high],
            "effort": f}}}.

    Raises:
        UserError: unknown keys or names, a range upside down.
    """
    given = given or {}
    channels = Channels.of(model)
    _known(given, {"joints": channels.joints, "actuators": channels.actuators})
    source: dict[str, str] = {}
    low, high, speed = np.full(model.nv, -np.inf), np.full(model.nv, np.inf), np.full(model.nv, np.inf)
    for j, name in enumerate(channels.joints):
        if int(model.jnt_type[j]) in AXIAL:
            v = int(model.jnt_dofadr[j])
            own = given.get("joints", {}).get(name, {})
            low[v], high[v], speed[v], source[name] = _of_joint(model, j, logs, own)
    bounds = given.get("actuators", {})
    rows = [_of_actuator(model, i, logs, bounds.get(n, {})) for i, n in enumerate(channels.actuators)]
    source |= {n: row[3] for n, row in zip(channels.actuators, rows, strict=True)}
    commands = np.array([row[:3] for row in rows], float).reshape(-1, 3)
    return Limits(low, high, speed, commands[:, 0], commands[:, 1], commands[:, 2], source)


def _known(given: Mapping[str, Any], names: Mapping[str, Sequence[str]]) -> None:
    for section, entries in given.items():
        if section not in _KEYS:
            raise UserError(f"limits.{section}: {suggest(section, list(_KEYS))}")
        for name, own in entries.items():
            if name not in names[section]:
                raise UserError(f"limits.{section}.{name}: not in the model; {suggest(name, names[section])}")
            for key, value in own.items():
                if key not in _KEYS[section]:
                    raise UserError(f"limits.{section}.{name}.{key}: allowed: {', '.join(_KEYS[section])}")
                if np.ndim(value) and not value[0] < value[1]:
                    raise UserError(f"limits.{section}.{name}.{key} = {list(value)}: allowed: low < high")


def _of_joint(model: mujoco.MjModel, j: int, logs: Sequence[Log], own: Mapping[str, Any]) -> tuple:
    q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    moved = np.concatenate([log.qpos[:, q] for log in logs])
    fast = np.percentile(np.abs(np.concatenate([log.qvel[:, v] for log in logs])), 99.5)
    driven = bool(np.any((model.actuator_trnid[:, 0] == j) & (model.actuator_trntype <= 1)))
    speed = float(own.get("speed", BEYOND * fast if driven else np.inf))
    if "range" in own:
        return float(own["range"][0]), float(own["range"][1]), speed, "given"
    if model.jnt_limited[j]:
        return (
            float(model.jnt_range[j, 0]),
            float(model.jnt_range[j, 1]),
            speed,
            "range of the model, speed of the logs",
        )
    if not driven:
        return -np.inf, np.inf, speed, "not driven: free"
    middle, half = (moved.max() + moved.min()) / 2, BEYOND * np.ptp(moved) / 2
    return middle - half, middle + half, speed, "110 % of the logs"


def _of_actuator(model: mujoco.MjModel, i: int, logs: Sequence[Log], own: Mapping[str, Any]) -> tuple:
    sent = np.concatenate([log.ctrl[:, i] for log in logs])
    middle, half = (sent.max() + sent.min()) / 2, BEYOND * np.ptp(sent) / 2
    low, high, source = middle - half, middle + half, "110 % of the logs"
    if "command" in own:
        (low, high), source = own["command"], "given"
    elif model.actuator_ctrllimited[i]:
        (low, high), source = model.actuator_ctrlrange[i], "range of the model"
    if "effort" in own:
        return low, high, float(own["effort"]), source
    if model.actuator_forcelimited[i]:
        return low, high, float(np.abs(model.actuator_forcerange[i]).max()), source
    if not model.actuator_biasprm[i, 1:3].any():  # force proportional to the command
        return low, high, float(max(abs(low), abs(high)) * abs(model.actuator_gainprm[i, 0])), source
    pulled = np.concatenate([commanded(log, model)[:, i] for log in logs])
    return low, high, BEYOND * float(np.abs(pulled).max()), source


def middle(limits: Limits, logs: Sequence[Log], model: mujoco.MjModel) -> tuple[Array, Array]:
    """(qpos to start from `[nq]`, usable half range `[nv]`): the logs' middle, moved away from the ends."""
    start = np.array(logs[0].qpos[0])
    half = np.full(model.nv, np.inf)
    for j in range(model.njnt):
        if int(model.jnt_type[j]) not in AXIAL:
            continue
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        seen = float(np.median(np.concatenate([log.qpos[:, q] for log in logs])))
        width = limits.high[v] - limits.low[v]
        if np.isfinite(width):
            start[q] = np.clip(seen, limits.low[v] + 0.3 * width, limits.high[v] - 0.3 * width)
            half[v] = min(limits.high[v] - start[q], start[q] - limits.low[v])
    return start, half


@dataclass(frozen=True, eq=False)
class Drives:
    """How each actuator is commanded: u = unit * target, or for torque unit * (feed-forward + kp e + kd de/dt).

    Attributes:
        kind: `[nu]`, one of KINDS; joint: `[nu]` names ("" where it drives no hinge or slide).
        q, v: `[nu]`, columns in qpos and qvel; unit: `[nu]`, ctrl per joint unit; kp, kd: `[nu]`, in ctrl units.
    """

    kind: tuple[str, ...]
    joint: tuple[str, ...]
    q: NDArray[np.int64]
    v: NDArray[np.int64]
    unit: Array
    kp: Array
    kd: Array

    def joints(self) -> dict[str, int]:
        """{joint: dof} that can be moved."""
        return {n: int(v) for n, v, kind in zip(self.joint, self.v, self.kind, strict=True) if n and kind != "none"}


def drives_of(model: mujoco.MjModel, law: Any, inertia: Array, dt: float) -> Drives:
    """law: of the logs, leading axis windows, or None; inertia: `[nv]`; dt: s, control period."""
    names = Channels.of(model).joints
    own = None if law is None else jax.tree.map(lambda x: np.asarray(x[0]), law)
    rows = [_drive(model, i, own) for i in range(model.nu)]
    joints = [j for _, j, _ in rows]
    v = np.array([model.jnt_dofadr[max(j, 0)] for j in joints], np.int64)
    sharing = np.array([sum(j == other for other in joints) for j in joints], float)
    unit = np.array([u for _, _, u in rows]) / np.where([k == "torque" for k, _, _ in rows], sharing, 1.0)
    omega = min(BANDWIDTH, 0.25 / dt)
    torque = np.array([k == "torque" for k, _, _ in rows])
    speed = np.array([k == "velocity" for k, _, _ in rows])
    return Drives(
        kind=tuple(k for k, _, _ in rows),
        joint=tuple(names[j] if j >= 0 else "" for j in joints),
        q=np.array([model.jnt_qposadr[max(j, 0)] for j in joints], np.int64),
        v=v,
        unit=unit,
        kp=unit * np.where(torque, inertia[v] * omega**2, np.where(speed, 2.0, 0.0)),
        kd=unit * np.where(torque, 1.6 * omega * inertia[v], 0.0),
    )


def _drive(model: mujoco.MjModel, i: int, law: Any) -> tuple[str, int, float]:
    """(kind, joint, ctrl per joint unit) of one actuator."""
    j, gear = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0])
    gain = float(model.actuator_gainprm[i, 0])
    if dof_of(model, i) is None:
        return "none", -1, 0.0
    if law is not None and law.on_position[i] > 0:
        return "position", j, 1.0
    if law is not None and law.on_velocity[i] > 0:
        return "velocity", j, 1.0
    scale = 1.0 if law is None else float(law.scale[i])
    if int(model.actuator_gaintype[i]) != int(mujoco.mjtGain.mjGAIN_FIXED) or gain * gear * scale == 0:
        return "none", j, 0.0
    b = model.actuator_biasprm[i]
    if b[1]:
        return "position", j, float(-b[1] * gear / gain / scale)
    if b[2]:
        return "velocity", j, float(-b[2] * gear / gain / scale)
    return "torque", j, 1.0 / (gain * gear * scale)


@dataclass(frozen=True, eq=False)
class Excitation:
    """One motion of the menu.

    Attributes:
        kind: its name in the menu; where: joint, or "all".
        offset: `[T, nv]`, reference motion relative to the middle position, at full amplitude.
        live: `[T, nv]`, 0 while the joint's drive is to be off.
        sharp: jumps are meant, and not smoothed away.
    """

    kind: str
    where: str
    offset: Array
    live: Array
    sharp: bool = False

    @property
    def name(self) -> str:
        return f"{self.kind} on {'all joints together' if self.where == 'all' else self.where}"


@dataclass(frozen=True, eq=False)
class Room:
    """What motions have: time `[T]` s, and of each degree of freedom `[nv]` the usable half range and largest speed."""

    time: Array
    half: Array
    speed: Array


def menu(room: Room, joints: Mapping[str, int], alone: Sequence[str], release: Sequence[str]) -> list[Excitation]:
    """Every kind of motion on single joints, and on all together.

    Slow triangles show dry friction and play, staircases of speeds what grows with speed, chirps and multisines timing
    and inertia, steps the limits of drives and deadbands, fast strokes the speed-torque curve.

    Args:
        joints: {name: dof} that are concerned; alone: names of those moved one at a time.
        release: names of the joints whose drive can be switched off.
    """
    places = [*alone, *(["all"] if len(joints) > 1 else [])]
    each = [(kind, place) for kind in SHAPES for place in places if kind != RELEASE or place in release]
    return [_of(kind, place, room, joints) for kind, place in each]


def _of(kind: str, place: str, room: Room, joints: Mapping[str, int]) -> Excitation:
    time, shape = room.time, (len(room.time), len(room.half))
    offset, live = np.zeros(shape), np.ones(shape)
    own = joints if place == "all" else {place: joints[place]}
    for k, v in enumerate(own.values()):
        # together, each joint at a pace of its own, so that their motions are not alike
        pace = 1.0 if len(own) == 1 else 0.55 + 0.45 * ((k * 0.618) % 1.0)
        reach = room.half[v] if len(own) == 1 else 0.7 * room.half[v]
        offset[:, v] = SHAPES[kind](time, reach, pace * room.speed[v])
        if kind == RELEASE:
            live[:, v] = np.mod(time, time[-1] / 3) < 0.6 * time[-1] / 3
    return Excitation(kind, place, offset, live, SHAPES[kind] is _steps)


def _triangle(way: Array, a: float) -> Array:
    """Position `a`-bounded after a way travelled back and forth, starting in the middle."""
    return 2 * a / np.pi * np.arcsin(np.sin(np.pi / 2 * way / a))


def _slow(t: Array, a: float, v: float) -> Array:
    return _triangle(max(0.06 * v, 1.5 * a / t[-1]) * t, a)


def _staircase(t: Array, a: float, v: float) -> Array:
    level = np.array([0.06, 0.12, 0.25, 0.5, 0.85])[np.minimum((5 * t / t[-1]).astype(int), 4)]
    return _triangle(np.cumsum(level * v) * (t[1] - t[0]), a)


def _strokes(t: Array, a: float, v: float) -> Array:
    """At top speed from end to end with a rest of 0.2 s at every turn."""
    stroke, dt = 2 * a / (0.9 * v), t[1] - t[0]
    moving = np.mod(t + stroke / 2, stroke + 0.2) < stroke
    return _triangle(np.cumsum(0.9 * v * moving) * dt, a)


def _fastest(t: Array) -> float:
    """Hz, the highest frequency to be sent."""
    return float(min(8.0, 0.1 / (t[1] - t[0])))


def _chirp(t: Array, a: float, v: float) -> Array:
    low, high = 0.15, _fastest(t)
    f = low * (high / low) ** (t / t[-1])
    phase = 2 * np.pi * np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2 * np.diff(t))])
    return np.minimum(0.8 * a, 0.7 * v / (2 * np.pi * f)) * np.sin(phase)


def _multisine(t: Array, a: float, v: float) -> Array:
    """With phases that keep its peaks low (Schroeder, IEEE Trans. Inf. Theory 16, 1970)."""
    f = np.round(np.geomspace(0.2, _fastest(t), 10) * t[-1]) / t[-1]
    lines = np.sin(2 * np.pi * np.outer(t, f) - np.pi * np.arange(len(f)) ** 2 / len(f)) / f**0.8
    x = lines.sum(1) - lines[0].sum()
    return x * min(0.8 * a / np.abs(x).max(), 0.8 * v / np.abs(np.gradient(x, t)).max())


def _steps(t: Array, a: float, v: float) -> Array:
    levels = a * np.array([0.0, 0.15, -0.15, 0.4, -0.4, 0.8, -0.8, 0.0])
    wanted, out = levels[np.minimum((8 * t / t[-1]).astype(int), 7)], np.zeros(len(t))
    reach = 0.9 * v * (t[1] - t[0])
    for k in range(1, len(t)):
        out[k] = out[k - 1] + np.clip(wanted[k] - out[k - 1], -reach, reach)
    return out


def _through(*levels: float) -> Callable[[Array, float, float], Array]:
    """In straight lines from level to level, shares of the range."""
    return lambda t, a, v: np.interp(t, np.linspace(0, t[-1], len(levels)), a * np.array(levels))


def _reversals(t: Array, a: float, v: float) -> Array:
    """Small slow strokes that grow from 1 % to 12 % of the range: presliding, play and deadband."""
    size = a * 0.01 * 12 ** (t / t[-1])
    return size * _triangle(4 * t, 1.0)


RELEASE = "hold and release"
SHAPES: dict[str, Callable[[Array, float, float], Array]] = {
    "slow triangle": _slow,
    "staircase of speeds": _staircase,
    "chirp": _chirp,
    "multisine": _multisine,
    "steps of three sizes": _steps,
    "ramps and holds": _through(*np.repeat([0.0, 0.45, 0.9, 0.45, 0.0, -0.45, -0.9, -0.45], 2).tolist()),
    "small reversals": _reversals,
    RELEASE: _through(0.0, 0.35, 0.35, -0.6, -0.6, 0.85, 0.85),
    "fast driving and braking": _strokes,
}
