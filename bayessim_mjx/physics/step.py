"""The one control step: command -> effects -> MJX sub-steps -> effects -> measurement. Tasks and diagnosis call it.

Its sub-steps are those of `timestep`: MJX's, where no effect, drive or limit says otherwise.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import early, under_tendon_limit
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics.controllers import Drive
from bayessim_mjx.physics.gates import chained_in
from bayessim_mjx.physics.model import PARTS, Physics, World, state_of
from bayessim_mjx.physics.pushed import Memory, apart, together
from bayessim_mjx.physics.timestep import substep


def control_step(
    physics: Physics,
    world: World,
    command: jax.Array,
    drive: Drive = Drive(),  # noqa: B008  # immutable
) -> tuple[World, mjx.Data]:
    """Advance one world by one control step.

    Args:
        physics: static.
        world: the state.
        command: `[nu]`, in the units of the actuators' ctrl, or `[substeps, nu]`, one row per sub-step; MuJoCo clips it
            to ctrlrange where ctrllimited.
        drive: what else acts.

    Returns:
        (world after the step, `mjx.Data` of the last sub-step: its state is the new one; its poses, contacts and forces
        are those computed *before* the last integration, as after `mjx.step`).
    """
    with jax.default_matmul_precision("highest"):  # a GPU would round the inputs of its products to TF32
        return _control_step(physics, world, command, drive)


def _control_step(physics: Physics, world: World, command: jax.Array, drive: Drive) -> tuple[World, mjx.Data]:
    _refuse(physics, drive)
    thetas = physics.split(world.theta)[1]
    commands = jnp.broadcast_to(command, (physics.substeps, physics.mj_model.nu))
    memory, commands = _commanded(physics, thetas, world.memory, commands, drive.active)
    slopes = None
    if physics.rows > 1:
        commands, slopes = _moments(physics, commands, drive)
    carry = memory, apart(physics, world.forces)
    if physics.warp is None:
        model, start = physics.model_of(world), physics.data_of(world)
        data, (final, rows) = _timesteps(
            physics, model, start, commands, slopes, carry, thetas, world.measurement, drive
        )
    else:
        data = physics.warp.together(functools.partial(_by_warp, physics), world.fields, state_of(world), commands)
        final, rows = carry  # no effect acts inside
    remembered, measurement = physics.sense(thetas, final, {"qpos": data.qpos, "qvel": data.qvel}, drive.active)
    world = world.replace(
        qpos=data.qpos,
        qvel=data.qvel,
        act=data.act,
        warmstart=data.qacc_warmstart,
        time=data.time,
        memory=remembered,
        forces=together(physics, rows),
        measurement=measurement,
    )
    return world, data


def _moments(physics: Physics, commands: jax.Array, drive: Drive) -> tuple[jax.Array, jax.Array | None]:
    """Mean of the commands `[substeps PARTS, nu]` over each timestep, and their slope, `[substeps, nu]` each.

    The slope is that of the line that moves velocities and positions as far as the parts do: of the same first moment.
    A law is held over the timestep.
    """
    each = commands.reshape(physics.substeps, PARTS, -1)
    from_middle = (jnp.arange(PARTS) + 0.5) / PARTS - 0.5
    return each.mean(1), None if drive.law is not None else jnp.einsum("p,spu->su", 12 / PARTS * from_middle, each)


def _timesteps(
    physics: Physics,
    model: mjx.Model,
    start: mjx.Data,
    commands: jax.Array,
    slopes: jax.Array | None,
    carry: Memory,
    thetas: tuple,
    seen: dict[str, jax.Array],
    drive: Drive,
) -> tuple[mjx.Data, Memory]:
    """Return (data, (memories, forces)) after a timestep for each row of commands; see `substep`."""

    def body(carry: tuple, row: tuple) -> tuple[tuple, None]:
        data, own = carry
        return substep(physics, model, data.replace(ctrl=row[0]), own, thetas, seen, drive, row[1]), None

    if physics.substeps == 1:
        return body((start, carry), (commands[0], None if slopes is None else slopes[0]))[0]
    return jax.lax.scan(body, (start, carry), (commands, slopes), unroll=physics.unroll)[0]


def _by_warp(physics: Physics, scratch: mjx.Data, fields: dict, state: dict, commands: jax.Array) -> mjx.Data:
    """`_timesteps` of Warp, from MuJoCo's state in the data `scratch`."""
    model = physics.warp.model_of(fields)  # type: ignore[union-attr]  # there is one, or nobody asks for this
    return _timesteps(physics, model, scratch.replace(**state), commands, None, ((), ()), (), {}, Drive())[0]


def _commanded(
    physics: Physics, thetas: tuple, memory: tuple, commands: jax.Array, active: jax.Array | None
) -> tuple[tuple, jax.Array]:
    """(memory, commands `[substeps rows, nu]`) behind all effects on commands; commands: `[substeps, nu]`."""
    commands = jnp.repeat(commands, physics.rows, axis=0)

    def hook(i: int, remembered: Any, commands: jax.Array) -> tuple[Any, jax.Array]:
        return physics.effects[i].on_command(physics.sites[i], remembered, commands, thetas[i])

    return chained_in(active, physics.having("on_command"), hook, memory, commands)


def _refuse(physics: Physics, drive: Drive) -> None:
    """UserError where what acts cannot be simulated."""
    given = [name for name, value in vars(drive).items() if value is not None]
    if physics.warp is not None and given:
        raise UserError(
            f"env.impl = 'warp': Drive({', '.join(given)}) acts inside the timestep, which Warp computes as a whole; "
            "allowed: env.impl = 'jax'"
        )
    if drive.enabled is not None and under_tendon_limit(physics.mj_model).any():
        raise UserError(
            "a drive cannot be switched off where a tendon has an actuatorfrcrange, which MJX takes before that; "
            "allowed: forcerange at the actuators in its place"
        )


def begin(physics: Physics, theta: jax.Array, motion: Motion, active: jax.Array | None = None) -> World:
    """Return a world in the middle of a log: effects' memories filled by the recorded past, sensors' effects undone.

    What follows the motion (`Effect.follows`) remembers nothing here; `retraced` takes it through the past.

    Args:
        theta: `[d]`; motion: measured, around the start, with the commands before it; active: see `Drive`.
    """
    return _begun(physics, theta, motion, active)[0]


def _begun(
    physics: Physics, theta: jax.Array, motion: Motion, active: jax.Array | None, fields: dict | None = None
) -> tuple[World, Motion]:
    """Return the world that `begin` gives, and the true motion around its start; fields: the world's, where known."""
    shown = motion.qpos[motion.start], motion.qvel[motion.start]  # what was measured
    world = physics.unseen(theta, *shown, fields)
    thetas, memory = physics.split(world.theta)[1], list(world.memory)
    for i in reversed(range(len(physics.effects))):  # sensors come last in a step, so they are undone first
        memory[i], motion = physics.effects[i].on_start(physics.sites[i], memory[i], motion, thetas[i])

    def past(memory: tuple, commands: jax.Array) -> tuple[tuple, None]:
        return _commanded(physics, thetas, memory, commands, active)[0], None

    filled = tuple(memory)
    if motion.start:
        filled, _ = jax.lax.scan(past, filled, motion.command[: motion.start])
    return world.replace(qpos=motion.qpos[motion.start], qvel=motion.qvel[motion.start], memory=filled), motion


class Past(struct.PyTreeNode):
    """Control steps before a start, through which what `Effect.follows` is taken along the recorded motion.

    Attributes:
        physics: static; start: the world that they lead up to.
        world: at the first of them, `start` itself where there are none; motion: the true one.
        steps: how many, static; wanted: `[]` bool, whether an active effect needs them.
        ahead: `[2 nv]`, by which motors are further ahead of their links than the past says (`Effect.on_motors`).
    """

    physics: Physics = struct.field(pytree_node=False)
    start: World
    world: World
    motion: Motion
    steps: int = struct.field(pytree_node=False)
    wanted: jax.Array
    ahead: jax.Array | None = None

    @property
    def first(self) -> int | jax.Array:
        """The control step to begin with: where none of them is wanted, that of the start."""
        return jnp.where(self.wanted, 0, self.steps) if self.steps else 0

    def led(self, k: jax.Array, world: World) -> World:
        """Begin control step k; from `steps` on it is simulated freely, from the start.

        Args:
            k: one for all worlds of a call, so that under `vmap` a branch stays a branch.
            world: after step k - 1.
        """
        if not self.steps:
            return world

        def along() -> World:
            before = early(self.physics.mj_model) * world.warmstart
            return self._recorded(world, world.replace(qpos=self.motion.qpos[k], qvel=self.motion.qvel[k] - before))

        arrived = functools.partial(self.arrived, world)
        return jax.lax.cond(k < self.steps, along, lambda: jax.lax.cond(k == self.steps, arrived, lambda: world))

    def arrived(self, world: World) -> World:
        """Return the start as what followed the motion up to it leaves it; world: after the last step."""

        def kept(new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(self.wanted, new, old)

        own = self._recorded(world, self.start.replace(memory=world.memory))
        each = zip(self.physics.effects, own.memory, self.start.memory, strict=True)
        memory = (jax.tree.map(kept, new, old) if effect.follows else old for effect, new, old in each)
        qpos, qvel = kept(own.qpos, self.start.qpos), kept(own.qvel, self.start.qvel)
        return self._ahead(self.start.replace(memory=tuple(memory), qpos=qpos, qvel=qvel))

    def _ahead(self, world: World) -> World:
        """Return the start with motors further ahead of their links."""
        if self.ahead is None:
            return world
        return self._changed("on_motors", dict(zip(("qpos", "qvel"), jnp.split(self.ahead, 2), strict=True)), world)

    def _recorded(self, before: World, after: World) -> World:
        """`after`, a recorded state with the memories of `before`, as what follows the motion takes it."""
        return self._changed("on_record", {"qpos": before.qpos, "qvel": before.qvel}, after)

    def _changed(self, hook: str, given: dict[str, jax.Array], world: World) -> World:
        """Return the world as the effects' hooks of this name leave it, which get what is `given` and its state."""
        state, memory = {"qpos": world.qpos, "qvel": world.qvel}, list(world.memory)
        thetas = self.physics.split(world.theta)[1]
        for i in self.physics.having(hook):
            change = getattr(self.physics.effects[i], hook)
            memory[i], state = change(self.physics.sites[i], memory[i], given, state, thetas[i])
        return world.replace(memory=tuple(memory), **state)


def past_of(physics: Physics, start: World, motion: Motion, active: jax.Array | None = None) -> Past:
    """Return the motion up to the start that `begin` gives for its theta and the same `motion` and `active`."""
    follows = np.array([effect.follows for effect in physics.effects], bool)
    if not follows.any() or not motion.start:
        return Past(physics, start, start, motion, 0, jnp.array(False))
    steps, time = motion.start, motion.time
    before = None if time is None else jnp.maximum(time - steps * physics.dt, 0.0)
    world, motion = _begun(physics, start.theta, motion.replace(start=0, time=before), active, start.fields)
    wanted = jnp.array(True) if active is None else jnp.any(active & follows)
    return Past(physics, start, world, motion, steps, wanted)


def retraced(physics: Physics, theta: jax.Array, motion: Motion, drive: Drive = Drive()) -> World:  # noqa: B008
    """`begin`, with the memory of what follows the motion as the recorded past leaves it; drive: what else acted."""
    past = past_of(physics, begin(physics, theta, motion), motion)

    def step(k: jax.Array, world: World) -> World:
        return control_step(physics, past.led(k, world), motion.command[k], drive)[0]

    return past.arrived(jax.lax.fori_loop(0, past.steps, step, past.world)) if past.steps else past.start
