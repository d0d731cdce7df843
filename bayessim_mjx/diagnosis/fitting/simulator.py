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

FAR = 1e3  # rad or m, rad/s or m/s: the error of a simulation that diverged, above all motion; a rule of thumb


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
    """Return the robot with these effects, for windows cut with `centred=False`."""
    return robot.physics(dt, (*effects, Centred()))


@dataclass(frozen=True)
class Call:
    """Worlds in one call."""

    # fewer are padded, more are cut. A CPU wants them in its cache and one call on each core. Measured with a pendulum:
    # 2.2 times as fast as 1024
    cpu_lanes: int = 64
    lanes: int = 4096  # an accelerator wants as many as it can get; not counted


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
        starts: numbers s of a start state: positions and velocities, and those of motors beside their links.
    """

    def __init__(self, physics: Physics, windows: Windows, lanes: int | None = None) -> None:
        self.physics, self.windows = physics, windows
        on_cpu = jax.default_backend() == "cpu"
        self.lanes = lanes or (CALL.cpu_lanes if on_cpu else CALL.lanes)
        self.apart = on_cpu
        self.nv = int(physics.mj_model.nv)
        self.rollouts = 0
        self._run = programs.Kept(self._many, programs.traced_from(physics, "windows"))
        self._moving, self._late = physics.having("on_motors"), physics.having("echoes")
        self.starts = (4 if self._moving else 2) * self.nv
        self._no_offset = np.zeros((self.lanes, self.starts), np.float32)
        self._no_force = jnp.asarray(np.zeros((self.lanes, windows.steps, self.nv), np.float32))
        nominal = jnp.asarray(np.asarray(physics.space.nominal, np.float32))
        size = jax.eval_shape(lambda theta: _packed(physics.unseen(theta, None, None, {})), nominal).size
        self._measured: tuple[Any, Any] = jnp.asarray(np.zeros((self.lanes, size), np.int32)), np.array(True)

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
        before: jax.Array,
        anew: jax.Array,
        active: jax.Array | None,
    ) -> tuple[jax.Array, jax.Array]:
        """Errors `[n, H, 2 nv]` of windows (positions, velocities), and the worlds at their ends as `_packed` has them.

        Worlds are side by side inside the loop: `vmap` of a loop would trace its body several times over.

        Args:
            anew: `[]`, whether windows begin with the recorded motion; False: with the worlds `before` `[n, D]`.
        """
        begun = functools.partial(self._begun, batch, active, anew)
        own, past, back, first = jax.vmap(begun, out_axes=(0, 0, 0, None))(index, thetas, offsets, before)
        model, lead, (n, count, *_) = self.physics.mj_model, past.steps, own.command.shape
        start, longest = own.around.start, jnp.max(back) if self._late else 0
        command = jnp.concatenate([own.around.command[:, :start], own.command], axis=1)

        def step(k: jax.Array, carry: tuple) -> tuple:
            now, shown = carry
            at = k - lead - longest  # the control step of the window, negative before it
            row = jnp.maximum(at, 0)

            def one(
                past: Past, own: Batch, back: jax.Array, command: jax.Array, force: jax.Array, now: World
            ) -> tuple[World, tuple[jax.Array, jax.Array]]:
                here = jnp.maximum(start + jnp.where(k < lead, k - lead - back, at), 0)
                drive = Drive(
                    jnp.where(at < 0, 0.0, force[row]),
                    None if own.enabled is None else own.enabled[row],
                    own.law,
                    active,
                )
                now = past.led(k, now)
                new, data = control_step(self.physics, now, command[here], drive)
                velocity = new.measurement["qvel"] + early(model) * data.qacc
                waits = (k >= lead) & (at < -back) if self._late else jnp.array(False)
                if lead and own.around.time is not None:  # before a log begins nothing moves
                    waits |= k < lead + back - jnp.round(own.around.time / jnp.float32(self.physics.dt))
                if self._late or lead:
                    new = jax.tree.map(functools.partial(jnp.where, waits), now, new)
                return new, (new.measurement["qpos"], velocity)

            now, new = jax.vmap(one)(past, own, back, command, forces, now)
            return now, tuple(x.at[:, row].set(y) for x, y in zip(shown, new, strict=True))

        nothing = tuple(jnp.zeros((n, count, size)) for size in (model.nq, model.nv))
        ends, (qpos, qvel) = jax.lax.fori_loop(first, lead + longest + count, step, (past.world, nothing))
        return jax.vmap(self._errors)(own, qpos, qvel), jax.vmap(_packed)(ends)

    def _begun(
        self,
        batch: Batch,
        active: jax.Array | None,
        anew: jax.Array,
        index: jax.Array,
        theta: jax.Array,
        offset: jax.Array,
        before: jax.Array,
    ) -> tuple[Batch, Past, jax.Array, int | jax.Array]:
        """(one window, what leads up to its start, how much earlier it begins, the control step to begin with)."""
        own = jax.tree.map(lambda x: x[index], batch)
        late = self._lateness(theta)
        around, back = self._earlier(own.around, late, anew)
        world = begin(self.physics, theta, self._moved(around, offset, late), active)
        past = past_of(self.physics, world, around, active)
        start = jax.tree.map(functools.partial(jnp.where, anew), past.start, _unpacked(before, past.start))
        past = past.replace(start=start, world=past.world if past.steps else start, wanted=past.wanted & anew)
        if self._moving:
            past = past.replace(ahead=offset[2 * self.nv :])
        return own, past, back, past.first

    def _lateness(self, theta: jax.Array) -> jax.Array:
        """`[nv]`, control steps by which sensors show a window's start late."""
        each, sites, none = self.physics.split(theta)[1], self.physics.sites, jnp.zeros(self.nv)
        return sum((self.physics.effects[i].echoes(sites[i], each[i]) for i in self._late), none)

    def _earlier(self, motion: Motion, late: jax.Array, anew: jax.Array) -> tuple[Motion, jax.Array]:
        """Return (recorded motion that starts as many control steps earlier as sensors are late, how many).

        What they show at the window's start is older than it. Simulated from there, each row of a window is predicted,
        and by all models from a state that was measured as long before: a late sensor is as likely as a late command.
        The nearest row is taken: less than a row of a window is then older than its start, which is known.
        """
        if not self._late or not motion.start:
            return motion, jnp.int32(0)
        steps = jnp.clip(jnp.round(jnp.max(late)), 0, motion.start).astype(jnp.int32)
        back = jnp.where(anew, steps, 0)
        rows = jnp.maximum(jnp.arange(len(motion.qpos)) - back, 0)
        moved = {name: getattr(motion, name)[rows] for name in ("qpos", "qvel", "command")}
        time = None if motion.time is None else jnp.maximum(motion.time - back * jnp.float32(self.physics.dt), 0.0)
        return motion.replace(**moved, time=time), back

    def _moved(self, motion: Motion, offset: jax.Array, late: jax.Array) -> Motion:
        """Return the recorded motion with another state at its start, and moved as that is around it.

        What sensors remember begins there too: with the recorded start, rows that late sensors show of it would keep
        its noise, which no change of the start state takes away. A late sensor shows the start some steps after it.
        """
        speed = offset[self.nv : 2 * self.nv]
        ahead = (jnp.arange(len(motion.qpos))[:, None] - motion.start - late) * jnp.float32(self.physics.dt)
        qpos = jax.vmap(functools.partial(integrate, self.physics.mj_model))(
            motion.qpos, offset[: self.nv] + ahead * speed
        )
        return motion.replace(qpos=qpos, qvel=motion.qvel + speed)

    def _errors(self, own: Batch, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
        """`[H, 2 nv]`, of one window; not finite ones are FAR."""
        error = jax.vmap(functools.partial(difference, self.physics.mj_model))(own.qpos, qpos)
        error = jnp.concatenate([error, own.qvel - qvel], axis=1)
        return jnp.nan_to_num(error, nan=FAR, posinf=FAR, neginf=-FAR)

    def loose(self, theta: Array) -> NDArray[np.bool_]:
        """`[s]`, which numbers of a start state act: motors stand beside their links where an effect lets them."""
        out = np.arange(self.starts) < 2 * self.nv
        acting = self.physics.acting(np.asarray(theta, np.float32)[None])[0]
        if not any(acting[i] for i in self._moving):
            return out
        each = self.physics.split(jnp.asarray(np.asarray(theta, np.float32)))[1]
        for i in self._moving:
            own = np.asarray(self.physics.effects[i].transmits(self.physics.sites[i], each[i]))
            out |= np.concatenate([np.zeros(2 * self.nv, bool), own, own])
        return out

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
            offsets: `[n, W, s]`, changes of the measured start states; None: none.
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
        """`run` of worlds one by one: `[m, H, 2 nv]` for indices `[m]` of thetas and windows, offsets `[m, s]`."""
        return self._through([(self.windows.batch, np.asarray(of_window))], thetas, of_theta, offsets, force)

    def run_on(self, thetas: Array, offsets: Array, chains: Windows, chain: NDArray[np.int64]) -> Array:
        """Worlds simulated from window to window, each beginning where the one before it ends, by the same program.

        Args:
            thetas: `[m, P]`; offsets: `[m, s]`, changes of the measured states at the first windows' starts.
            chains: windows as long as one's own, at most as many at a time; chain: `[m, K]`, each world's in order.

        Returns:
            Measured minus simulated motion `[m, K H, 2 nv]`, as of `run`.
        """
        return self._through([self._part(chains, own) for own in chain.T], thetas, np.arange(len(thetas)), offsets)

    def _through(
        self,
        parts: Sequence[tuple[Batch, NDArray[np.int64]]],
        thetas: Array,
        of_theta: NDArray[np.int64],
        offsets: Array | None,
        force: NDArray[np.float32] | None = None,
    ) -> Array:
        """Errors `[m, K H, 2 nv]` of worlds that go through K windows: of each a batch, and indices `[m]` in it."""
        acting, thetas, count = self.physics.acting(thetas), np.asarray(thetas, np.float32), len(of_theta)
        moved = None if offsets is None else np.asarray(offsets, np.float32)

        def one(first: int) -> NDArray[np.float32]:
            own = first + np.minimum(np.arange(self.lanes), min(self.lanes, count - first) - 1)
            offset = self._no_offset if moved is None else moved[own]
            extra = self._no_force if force is None else force[own]
            active = acting[of_theta[own]].any(0) if self.apart else None
            found: list[NDArray[np.float32]] = []
            before, anew = self._measured
            for batch, index in parts:
                given = index[own], thetas[of_theta[own]], offset, extra, before, anew, active
                errors, before = self._run(batch, *given)
                found.append(np.asarray(errors)[: count - first])
                before = np.asarray(before)  # as JAX gives it, it stays on its device: for JAX another program
                offset, anew = self._no_offset, np.array(False)
            return np.concatenate(found, axis=1)

        firsts = range(0, count, self.lanes)
        alone = len(firsts) if not self.apart else 0 if self.rollouts else 1  # one thread compiles
        done = [*map(one, firsts[:alone]), *on_cores(one, firsts[alone:])]
        self.rollouts += count * len(parts)
        return np.concatenate(done).astype(np.float64)

    def _part(self, chains: Windows, which: NDArray[np.int64]) -> tuple[Batch, NDArray[np.int64]]:
        """Return some windows in a batch of the shape of one's own, and where in it each of `which` stands."""
        unique, index = np.unique(which, return_inverse=True)
        rows = np.resize(unique, len(self.windows))
        return jax.tree.map(lambda x: np.asarray(x)[rows], chains.batch), index


def _packed(world: World) -> jax.Array:
    """Return the bits of a world's state and of what its effects remember, `[D]`: a call takes time for each array."""
    leaves = jax.tree.leaves(world.replace(theta=(), fields={}))
    return jnp.concatenate([_cast(jnp.asarray(x), jnp.dtype("int32")).ravel() for x in leaves])


def _unpacked(packed: jax.Array, like: World) -> World:
    """Return the world that `_packed` was made of, with the theta and the model of another."""
    leaves, tree = jax.tree.flatten(like.replace(theta=(), fields={}))
    parts = jnp.split(packed, np.cumsum([x.size for x in leaves])[:-1])
    each = [_cast(part.reshape(x.shape), x.dtype) for part, x in zip(parts, leaves, strict=True)]
    return jax.tree.unflatten(tree, each).replace(theta=like.theta, fields=like.fields)


def _cast(x: jax.Array, to: Any) -> jax.Array:
    """Return the same bits, where both have 32."""
    same = x.dtype.itemsize == to.itemsize
    return jax.lax.bitcast_convert_type(x, to) if same else x.astype(to)
