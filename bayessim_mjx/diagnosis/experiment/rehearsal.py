"""Experiments rehearsed under all rivals, the loop closed around the reference, until all stay inside the limits."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from bayessim_mjx.compat import brief
from bayessim_mjx.diagnosis.experiment.limits import Excitation, Limits, drives_of, middle
from bayessim_mjx.diagnosis.selection.numbers import EFFORT
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import Drive, Physics, control_step

Array = NDArray[np.float64]


KEPT = 1.0 + 10.0 * float(np.finfo(np.float32).eps)  # share of a limit that may be used: all of it, but for rounding


class Plan(struct.PyTreeNode):
    """What the loop follows: ref, speed, feed `[T, nu]` (feed-forward, in ctrl units); live `[T, nu]`; start `[nq]`."""

    ref: jax.Array
    speed: jax.Array
    feed: jax.Array
    live: jax.Array
    start: jax.Array


@dataclass(frozen=True, eq=False)
class Played:
    """An experiment as the winner's simulator played it.

    Attributes:
        excitation; scale: of its amplitude; log: motion `[T + 1, ..]` and commands.
        worst: largest share of a limit that was used; safe: whether every rival stayed inside the limits.
    """

    excitation: Excitation
    scale: float
    log: Log
    worst: float
    safe: bool


class Rehearsal:
    """Closed-loop simulation of whole experiments under the effects of some models. One small program of its own.

    Args:
        setup: of the diagnosis; effects: names of effects that are needed; time: `[T]`, s.
    """

    def __init__(self, setup: Setup, effects: set[str], time: Array, limits: Limits) -> None:
        windows, model = setup.fitter.simulator.windows, setup.physics.mj_model
        self.setup, self.time, self.limits, self.windows = setup, time, limits, windows
        self.kept, some = _columns(setup.physics, effects)
        self.physics: Physics = setup.robot.physics(windows.dt, some)
        law = windows.batch.law
        self.law = None if law is None else jax.tree.map(lambda x: x[0], law)
        self.drives = drives_of(model, law, setup.scales.inertia, windows.dt)
        self.start, self.half = middle(limits, windows.logs, model)
        self.can_switch = windows.batch.enabled is not None
        self.rest = np.median(np.concatenate([log.ctrl for log in windows.logs]), axis=0)
        self.lanes = 0
        self._run = brief(jax.vmap(self._one), level=None)

    @property
    def count(self) -> int:
        """Windows of one experiment."""
        return len(self.time) // self.windows.steps

    @property
    def release(self) -> tuple[str, ...]:
        """Joints that can be let go."""
        d = self.drives
        return tuple(j for j, k in zip(d.joint, d.kind, strict=True) if k == "torque" or (j and self.can_switch))

    def _one(self, theta: jax.Array, plan: Plan) -> tuple:
        d, limits = self.drives, self.limits
        low, high = jnp.asarray(limits.command_low), jnp.asarray(limits.command_high)
        torque = jnp.asarray([k == "torque" for k in d.kind])
        world = self.physics.world(theta, plan.start)

        def step(world: Any, row: tuple) -> tuple[Any, tuple]:
            ref, speed, feed, live = row
            q, w = world.measurement["qpos"], world.measurement["qvel"]
            u = feed + jnp.asarray(d.kp) * (ref - q[d.q]) + jnp.asarray(d.kd) * (speed - w[d.v])
            u = jnp.clip(u, low, high)
            u = jnp.where(torque, live * u, u)
            enabled = jnp.where(torque, 1.0, live) if self.can_switch else None
            new, data = control_step(self.physics, world, u, Drive(None, enabled, self.law))
            return new, (q, w, u, data.actuator_force)

        end: Any
        rows: Any
        end, rows = jax.lax.scan(step, world, (plan.ref, plan.speed, plan.feed, plan.live))
        return rows, (end.measurement["qpos"], end.measurement["qvel"])

    def play(self, excitations: Sequence[Excitation], thetas: Array, gravity: Array | None = None) -> list[Played]:
        """All excitations under all models `[M, P]` (the first is the winner), made smaller until safe.

        Args:
            gravity: `[3]` in the frame of the base, where the mount is another one.
        """
        scale, done = np.ones(len(excitations)), {}
        left = list(range(len(excitations)))
        for _ in range(EFFORT.rounds):
            plans = [self._plan(excitations[k], scale[k], gravity) for k in left]
            runs = self._simulate(plans, thetas)
            for k, own in zip(left, runs, strict=True):
                worst = max(self._used(*run) for run in own)
                log = self._log(excitations[k], *own[0])
                done[k] = Played(excitations[k], float(scale[k]), log, worst, worst <= KEPT)
            left = [k for k in left if not done[k].safe]
            # by more than what is over, since a part does not shrink along (gravity); motion that diverged by a half
            scale[left] *= [max(done[k].worst ** -2, 0.5) for k in left]
            if not left:
                break
        return [done[k] for k in range(len(excitations))]

    def _simulate(self, plans: list[Plan], thetas: Array) -> list[list[tuple]]:
        """[plan][model] -> (qpos, qvel `[T + 1, ..]`, command, effort `[T, nu]`)."""
        pairs = [(p, m) for p in range(len(plans)) for m in range(len(thetas))]
        stacked = jax.tree.map(lambda *x: np.stack(x), *plans)
        small = np.asarray(thetas[:, self.kept], np.float32)
        out: list[list[tuple]] = [[] for _ in plans]
        self.lanes = self.lanes or len(pairs)  # the first call's, the largest one: no other size is compiled
        for a in range(0, len(pairs), self.lanes):
            some = pairs[a : a + self.lanes]
            padded = some + [some[-1]] * (self.lanes - len(some))
            index = np.array([p for p, _ in padded])
            chosen = Plan(**{f.name: getattr(stacked, f.name)[index] for f in fields(Plan)})
            rows, ends = self._run(small[[m for _, m in padded]], chosen)
            q, w, u, f = (np.asarray(x, np.float64) for x in rows)
            q_end, w_end = (np.asarray(x, np.float64)[:, None] for x in ends)
            q, w = np.concatenate([q, q_end], 1), np.concatenate([w, w_end], 1)
            for lane, (p, _) in enumerate(some):
                out[p].append((q[lane], w[lane], u[lane], f[lane]))
        return out

    def _plan(self, e: Excitation, scale: float, gravity: Array | None) -> Plan:
        """Return reference and feed-forward; motions are rounded off so that the drives can follow them."""
        d, dt, model = self.drives, self.windows.dt, self.setup.physics.mj_model
        offset = e.offset * scale
        for i, v in enumerate(d.v):
            if d.kind[i] != "none" and not (e.sharp and d.kind[i] == "position"):
                offset[:, v] = _rounded(offset[:, v], self._turn(offset[:, v], i), dt)
        speed = np.gradient(offset, dt, axis=0)
        ref = self.start[d.q] + offset[:, d.v]
        needed = np.zeros_like(offset)
        if "torque" in d.kind and not np.any(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)):
            needed = self._inverse(offset, gravity)
        kinds = np.array(d.kind)
        feed = np.where(
            kinds == "torque",
            d.unit * needed[:, d.v],
            np.where(
                kinds == "position", d.unit * ref, np.where(kinds == "velocity", d.unit * speed[:, d.v], self.rest)
            ),
        )
        arrays = (ref, speed[:, d.v], feed, e.live[:, d.v], self.start)
        return Plan(*(jnp.asarray(np.asarray(x, np.float32)) for x in arrays))

    def _inverse(self, offset: Array, gravity: Array | None) -> Array:
        """Generalised forces `[T, nv]` of the nominal model along the reference."""
        d, dt, model = self.drives, self.windows.dt, copy.copy(self.setup.physics.mj_model)
        if gravity is not None:
            model.opt.gravity[:] = gravity
        data, out = mujoco.MjData(model), np.zeros_like(offset)
        speed = np.gradient(offset, dt, axis=0)
        acceleration = np.gradient(speed, dt, axis=0)
        for k in range(len(offset)):
            data.qpos[:], data.qvel[:], data.qacc[:] = self.start, speed[k], acceleration[k]
            data.qpos[d.q] = self.start[d.q] + offset[k, d.v]
            mujoco.mj_inverse(model, data)
            out[k] = data.qfrc_inverse
        return out

    def _turn(self, offset: Array, i: int) -> float:
        """s, time in which actuator i can turn the motion round with half of its effort."""
        effort = self.limits.effort[i] * abs(self.setup.physics.mj_model.actuator_gear[i, 0])
        fastest = np.abs(np.diff(offset)).max() / self.windows.dt
        return float(np.clip(4 * fastest * self.setup.scales.inertia[self.drives.v[i]] / max(effort, 1e-9), 0, 0.6))

    def _used(self, qpos: Array, qvel: Array, command: Array, effort: Array) -> float:
        """Largest share of a limit that was used (command limits are clipped to, so they hold by construction)."""
        limits, model, shares = self.limits, self.setup.physics.mj_model, [0.0]
        if not (np.isfinite(qpos).all() and np.isfinite(qvel).all()):
            return np.inf
        for j in range(model.njnt):
            q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            width = (limits.high[v] - limits.low[v]) / 2
            if np.isfinite(width):
                shares.append(float(np.abs(qpos[:, q] - (limits.high[v] + limits.low[v]) / 2).max() / width))
            if np.isfinite(limits.speed[v]):
                shares.append(float(np.abs(qvel[:, v]).max() / limits.speed[v]))
        servo = [i for i, k in enumerate(self.drives.kind) if k in ("position", "velocity")]
        shares += [float(np.abs(effort[:, i]).max() / max(limits.effort[i], 1e-9)) for i in servo]
        return max(shares)

    def _log(self, e: Excitation, qpos: Array, qvel: Array, command: Array, effort: Array) -> Log:
        like = self.windows.logs[0]
        time = np.append(self.time, self.time[-1] + self.windows.dt)
        streams = {}
        for i, name in enumerate(like.actuators):
            off = e.live[:, self.drives.v[i]] < 0.5
            if self.can_switch and self.drives.kind[i] not in ("torque", "none") and off.any():
                streams[f"enabled:{name}"] = 1.0 - np.append(off, off[-1])
        controller = {k: v for k, v in like.metadata.items() if k == "controller"}
        return replace(
            like,
            name=e.name,
            time=time,
            ctrl=np.concatenate([command, command[-1:]]),
            qpos=qpos,
            qvel=qvel,
            streams=streams,
            metadata=controller,
        )


def _columns(physics: Physics, effects: set[str]) -> tuple[NDArray[np.int64], list]:
    """(columns of theta, effects) that are left when only the named effects stay in the stack."""
    kept = [b for b in physics.blocks if b.effect is None or b.effect.name in effects]
    columns = np.concatenate([np.arange(b.start, b.stop, dtype=np.int64) for b in kept])
    return columns, [e for e in physics.effects if e.name in effects]


def _rounded(x: Array, width: float, dt: float) -> Array:
    """Return moving average over `width` s, twice half of it, ends held: a jump of the speed becomes a ramp."""
    rows = max(1, int(round(width / 2 / dt)))
    return np.asarray(uniform_filter1d(uniform_filter1d(x, rows, mode="nearest"), rows, mode="nearest"))
