"""One compiled simulator for every candidate: (theta, window, start, force) -> measured minus simulated motion."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import programs
from bayessim_mjx.device import on_cores
from bayessim_mjx.diagnosis.fitting.robot import Robot
from bayessim_mjx.diagnosis.fitting.windows import Batch, Windows
from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.physics import Drive, Past, Physics, World, begin, control_step, early, past_of, staggered
from bayessim_mjx.physics.tangent import difference, integrate

Array = NDArray[np.float64]

FAR = 1e3  # rad or m, rad/s or m/s: the error of a simulation that diverged


@dataclass(frozen=True)
class Centred(Effect):
    """The command half a sub-step early (see `windows._fine_commands`); it has no parameters and is no candidate.

    It acts last: a rate limit or a dead band acts on the command that is sent, not on its mean over two sub-steps.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "centred"
    kind: ClassVar[str] = "world"
    quantities: ClassVar[tuple[Quantity, ...]] = ()

    def init(self, at: Site) -> Any:
        return {"last": jnp.zeros(at.nu), "fresh": jnp.ones((), bool)}

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        if not staggered(at.mj_model):
            return memory, command
        last = jnp.where(memory["fresh"], command[0], memory["last"])
        early = jnp.concatenate([last[None], command[:-1]])
        return {"last": command[-1], "fresh": jnp.zeros((), bool)}, 0.5 * (early + command)


def physics_of(robot: Robot, dt: float, effects: Sequence[Effect]) -> Physics:
    """The robot with these effects, for windows cut with `centred=False`."""
    return robot.physics(dt, (*effects, Centred()))


@dataclass(frozen=True)
class Call:
    """Worlds in one call."""

    # worlds in one call; fewer are padded, more are cut. A CPU wants them in its cache (a pendulum's: 2.2 times as
    # fast as 1024) and one call on each core, an accelerator as many as it can get
    cpu_lanes: int = 64
    lanes: int = 4096


CALL = Call()


class Simulator:
    """Windows under a stack of effects. One program for every value and subset of effects, and every start and force.

    Args:
        physics: with all effects in its stack.
        windows: what to simulate.
        lanes: worlds per call.

    Attributes:
        rollouts: windows simulated so far.
        apart: whether a world costs as much in a small call as in a large one: on a CPU, not on an accelerator.
    """

    def __init__(self, physics: Physics, windows: Windows, lanes: int | None = None) -> None:
        self.physics, self.windows = physics, windows
        on_cpu = jax.default_backend() == "cpu"
        self.lanes = lanes or (CALL.cpu_lanes if on_cpu else CALL.lanes)
        self.apart = on_cpu
        self.nv = int(physics.mj_model.nv)
        self.channels = 2 * self.nv
        self.rollouts = 0
        self._run = programs.Kept(self._many, programs.traced_from(physics, "windows"))
        self._no_offset = np.zeros((self.lanes, 2 * self.nv), np.float32)
        self._no_force = jnp.asarray(np.zeros((self.lanes, windows.steps, self.nv), np.float32))

    @property
    def programs(self) -> int:
        """Programs so far: 1, whatever is asked."""
        return self._run.count

    def _many(
        self,
        batch: Batch,
        index: jax.Array,
        thetas: jax.Array,
        offsets: jax.Array,
        forces: jax.Array,
        active: jax.Array | None,
    ) -> tuple[jax.Array, jax.Array]:
        """Errors `[n, H, 2 nv]` of windows (positions, velocities) and the actuators' forces `[n, H, nu]`.

        Worlds are side by side inside the loop: `vmap` of a loop would trace its body several times over.
        """
        begun = functools.partial(self._begun, batch, active)
        own, past, first = jax.vmap(begun, out_axes=(0, 0, None))(index, thetas, offsets)
        model, lead, (n, count, *_) = self.physics.mj_model, past.steps, own.command.shape
        command = jnp.concatenate([own.around.command[:, :lead], own.command], axis=1)

        def step(k: jax.Array, carry: tuple) -> tuple:
            now, shown = carry
            row = jnp.maximum(k - lead, 0)

            def one(past: Past, own: Batch, command: jax.Array, force: jax.Array, now: World) -> tuple:
                extra = jnp.where(k < lead, 0.0, force[row])
                drive = Drive(extra, None if own.enabled is None else own.enabled[row], own.law, active)
                now, data = control_step(self.physics, past.led(k, now), command[k], drive)
                velocity = now.measurement["qvel"] + early(model) * data.qacc
                return now, (now.measurement["qpos"], velocity, data.actuator_force)

            now, new = jax.vmap(one)(past, own, command, forces, now)
            return now, tuple(x.at[:, row].set(y) for x, y in zip(shown, new, strict=True))

        nothing = tuple(jnp.zeros((n, count, size)) for size in (model.nq, model.nv, model.nu))
        _, (qpos, qvel, effort) = jax.lax.fori_loop(first, lead + count, step, (past.world, nothing))
        return jax.vmap(self._errors)(own, qpos, qvel, past.start.theta), effort

    def _begun(
        self, batch: Batch, active: jax.Array | None, index: jax.Array, theta: jax.Array, offset: jax.Array
    ) -> tuple[Batch, Past, int | jax.Array]:
        """(one window, what leads up to its start, the control step to begin with)."""
        own = jax.tree.map(lambda x: x[index], batch)
        world = begin(self.physics, theta, self._moved(own.around, offset), active)
        past = past_of(self.physics, world, own.around, active)
        return own, past, past.first

    def _moved(self, motion: Motion, offset: jax.Array) -> Motion:
        """The recorded motion with another state at its start, and moved as that is around it.

        What sensors remember begins there too: with the recorded start, rows that late sensors show of it would keep
        its noise, which no change of the start state takes away.
        """
        speed = offset[self.nv :]
        ahead = (jnp.arange(len(motion.qpos)) - motion.start) * jnp.float32(self.physics.dt)
        away = offset[: self.nv] + ahead[:, None] * speed
        qpos = jax.vmap(functools.partial(integrate, self.physics.mj_model))(motion.qpos, away)
        return motion.replace(qpos=qpos, qvel=motion.qvel + speed)

    def _errors(self, own: Batch, qpos: jax.Array, qvel: jax.Array, theta: jax.Array) -> jax.Array:
        """`[H, 2 nv]`, of one window; not finite ones are FAR."""
        error = jax.vmap(functools.partial(difference, self.physics.mj_model))(own.qpos, qpos)
        errors = self._predicted(jnp.concatenate([error, own.qvel - qvel], axis=1), theta)
        return jnp.nan_to_num(errors, nan=FAR, posinf=FAR, neginf=-FAR)

    def _predicted(self, errors: jax.Array, theta: jax.Array) -> jax.Array:
        """Errors `[H, 2 nv]` in which what only echoes the recording counts as the first row that is predicted does."""
        echoing = self.physics.having("echoes")
        if not echoing:
            return errors
        each, sites = self.physics.split(theta)[1], self.physics.sites
        steps = sum(self.physics.effects[i].echoes(sites[i], each[i]) for i in echoing)
        count = len(errors)
        first = jnp.clip(jnp.ceil(jnp.asarray(steps) - 1e-3).astype(jnp.int32) - 1, 0, count - 1)
        row = jnp.maximum(jnp.arange(count)[:, None], jnp.tile(first, 2))
        return jnp.take_along_axis(errors, row, axis=0)

    def run(
        self,
        thetas: Array,
        offsets: Array | None = None,
        windows: NDArray[np.int64] | None = None,
        force: Array | None = None,
    ) -> Array:
        """Measured minus simulated motion.

        Args:
            thetas: `[n, P]`, values of `physics.space`.
            offsets: `[n, W, 2 nv]`, changes of the measured start states; None: none.
            windows: indices `[W]` of the windows wanted; None: all.
            force: `[n, W, H, nv]`, extra generalised force; None: none.

        Returns:
            `[n, W, H, 2 nv]`, positions then velocities; not finite values (diverged) are large numbers.
        """
        chosen = np.arange(len(self.windows)) if windows is None else np.asarray(windows)
        n, w = len(thetas), len(chosen)
        flat_offsets = None if offsets is None else np.asarray(offsets).reshape(n * w, -1)
        flat_force = None if force is None else np.asarray(force, np.float32).reshape(n * w, *force.shape[2:])
        result = self.run_each(thetas, np.repeat(np.arange(n), w), np.tile(chosen, n), flat_offsets, flat_force)
        return result.reshape(n, w, *result.shape[1:])

    def run_each(
        self,
        thetas: Array,
        of_theta: NDArray[np.int64],
        of_window: NDArray[np.int64],
        offsets: Array | None = None,
        force: NDArray[np.float32] | None = None,
    ) -> Array:
        """`run` of worlds one by one: `[m, H, 2 nv]` for indices `[m]` of thetas and windows, offsets `[m, 2 nv]`."""
        count = len(of_theta)
        moved = None if offsets is None else np.asarray(offsets, np.float32)
        acting, thetas = self.physics.acting(thetas), np.asarray(thetas, np.float32)

        def given(first: int) -> tuple:
            own = first + np.minimum(np.arange(self.lanes), min(self.lanes, count - first) - 1)
            offset = self._no_offset if moved is None else moved[own]
            extra = self._no_force if force is None else force[own]
            active = acting[of_theta[own]].any(0) if self.apart else None
            return self.windows.batch, of_window[own], thetas[of_theta[own]], offset, extra, active

        def part(first: int) -> NDArray[np.float32]:
            return np.asarray(self._run(*given(first))[0])[: count - first]

        firsts = list(range(0, count, self.lanes))
        if self.apart and not self.rollouts:
            self._run.ready(*given(0))  # once, not by every thread
        done = on_cores(part, firsts) if self.apart else [part(first) for first in firsts]
        self.rollouts += count
        return np.concatenate(done).astype(np.float64)
