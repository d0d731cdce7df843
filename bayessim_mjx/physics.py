"""The one control step: command -> effects -> MJX sub-steps -> effects -> measurement. Tasks and diagnosis call it.

The sub-step is composed of MJX's own stage functions in the order of `mjx.step`, so that an effect's force can depend
on this sub-step's bias, passive and actuator forces. Without effects it equals `mjx.step`.
"""

import contextlib
import io
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

with contextlib.redirect_stdout(io.StringIO()):  # MJX announces on import that the optional warp is absent
    from mujoco import mjx

from bayessim_mjx.effects import contract
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.site import Motion, SubStep
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.warp import Warp

_EULER, _RK4, _IMPLICITFAST = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{n}")) for n in ("EULER", "RK4", "IMPLICITFAST")
)

Memory = tuple[tuple, jax.Array]  # (memories of the effects, their last forces [effects, nv])
Seen = dict[str, jax.Array]  # what the sensors showed after the last control step: qpos [nq], qvel [nv], error [nq]


class World(struct.PyTreeNode):
    """Everything the next control step of one world needs. Lean: no `mjx.Data`; `vmap` adds leading axes.

    Attributes:
        qpos: `[nq]`, qvel: `[nv]`, act: `[na]`; MuJoCo's state.
        warmstart: `[nv]`, the last acceleration, where the constraint solver starts.
        time: `[]`, s.
        theta: `[d]`, the values of `physics.space` that hold in this episode.
        fields: model arrays that differ from the nominal ones, by dotted name (computed at reset, constant afterwards).
        memory: one pytree per effect.
        forces: `[effects, nv]`, each effect's generalised force in the last sub-step.
        measurement: `{"qpos", "qvel"}` as the sensors show them; equal to qpos, qvel unless an effect says otherwise.
        task: numbers a task carries along (commands, counters); physics does not read them.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warmstart: jax.Array
    time: jax.Array
    theta: jax.Array
    fields: dict[str, jax.Array]
    memory: tuple
    forces: jax.Array
    measurement: dict[str, jax.Array]
    task: dict[str, Any] = struct.field(default_factory=dict)


class Physics:
    """A compiled model with its parameters and effects. Immutable and hashable by identity: static under `jit`.

    Args:
        mj_model: the nominal MuJoCo model.
        control_dt: control step, s; a whole multiple of the model's timestep.
        space: parameters written into the model.
        effects: effects in the order in which their hooks are called.
        max_qvel: `[nv]` or scalar; velocities are clipped to +-max_qvel after each sub-step (the position has moved
            with the unclipped one). None: no clipping.
        impl: what computes a timestep: MJX's stages in "jax", or all of it in "warp"; see `warp.Warp`.
        worlds: how many are simulated together, for "warp".

    Raises:
        ValueError: if control_dt is no multiple of the timestep, the integrator is unknown to MJX, or an effect's
            `where` is not in the model.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        control_dt: float,
        space: ParameterSpace,
        effects: Sequence[Effect] = (),
        max_qvel: float | Sequence[float] | None = None,
        impl: str = "jax",
        worlds: int | None = None,
    ) -> None:
        self.mj_model = mj_model
        self.effects = tuple(effects)
        self.model_space = space
        self.space = space
        for effect in self.effects:
            self.space = self.space + effect.space()
        self.substeps = _substeps(control_dt, mj_model.opt.timestep)
        self.dt = float(self.substeps * mj_model.opt.timestep)
        if int(mj_model.opt.integrator) not in (_EULER, _RK4, _IMPLICITFAST):
            raise UserError(f"integrator {mj_model.opt.integrator}: MJX has Euler, RK4 and implicitfast")
        self.max_qvel = None if max_qvel is None else np.broadcast_to(np.asarray(max_qvel, np.float32), (mj_model.nv,))
        self.model = mjx.put_model(mj_model, impl="jax")
        self.template = mjx.make_data(mj_model, impl="jax")
        self.warp = Warp(mj_model, self.template, self.effects, worlds) if impl == "warp" else None
        timestep = float(mj_model.opt.timestep)
        for effect in filter(contract.brought, self.effects):
            contract.check(effect, mj_model, self.model, self.substeps)
        self.sites = tuple(effect.bind(mj_model, timestep, self.substeps) for effect in self.effects)
        self._memory = tuple(effect.init(at) for effect, at in zip(self.effects, self.sites, strict=True))

    def split(self, theta: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """(values of the model's parameters, one slice per effect)."""
        start = len(self.model_space)
        own, slices = theta[:start], []
        for effect in self.effects:
            end = start + len(effect.space())
            slices.append(theta[start:end])
            start = end
        return own, tuple(slices)

    def world(self, theta: jax.Array, qpos: jax.Array | None = None, qvel: jax.Array | None = None) -> World:
        """A world at the start of an episode; writes `theta` into the model once.

        Args:
            theta: `[d]`, values of `self.space`.
            qpos: `[nq]`, default the model's qpos0.
            qvel: `[nv]`, default zero.

        Raises:
            ValueError: on a wrong shape.
        """
        with jax.default_matmul_precision("highest"):
            return self._world(theta, qpos, qvel)

    def _world(self, theta: jax.Array, qpos: jax.Array | None, qvel: jax.Array | None) -> World:
        theta = jnp.asarray(theta, jnp.float32)
        qpos = jnp.asarray(self.mj_model.qpos0 if qpos is None else qpos, jnp.float32)
        qvel = jnp.zeros(self.mj_model.nv) if qvel is None else jnp.asarray(qvel, jnp.float32)
        for label, value, size in (
            ("theta", theta, len(self.space)),
            ("qpos", qpos, self.mj_model.nq),
            ("qvel", qvel, self.mj_model.nv),
        ):
            if value.shape != (size,):
                raise ValueError(f"{label} has shape {value.shape}, expected ({size},)")
        own, slices = self.split(theta)
        model = self.model_space.write(self.model, own)
        for effect, at, part in zip(self.effects, self.sites, slices, strict=True):
            model = effect.on_model(at, model, part)
        return World(
            qpos=qpos,
            qvel=qvel,
            act=jnp.zeros(self.mj_model.na),
            warmstart=jnp.zeros(self.mj_model.nv),
            time=jnp.zeros(()),
            theta=theta,
            fields=_changed(self.model, model),
            memory=self._memory,
            forces=jnp.zeros((len(self.effects), self.mj_model.nv)),
            measurement={"qpos": qpos, "qvel": qvel},
        )

    def model_of(self, world: World) -> mjx.Model:
        """The model with this world's parameters."""
        return self.model.tree_replace(world.fields) if world.fields else self.model

    def data_of(self, world: World, template: mjx.Data | None = None) -> mjx.Data:
        """`mjx.Data` in this world's state; everything derived from the state is the template's (not this state's)."""
        return (self.template if template is None else template).replace(
            qpos=world.qpos, qvel=world.qvel, act=world.act, qacc_warmstart=world.warmstart, time=world.time
        )

    def kinematics(self, world: World) -> mjx.Data:
        """`mjx.Data` with the poses and velocities of all bodies in this world's state; no contacts, no forces."""
        model, data = self.model_of(world), self.data_of(world)
        return mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))


def _substeps(control_dt: float, timestep: float) -> int:
    count = round(control_dt / timestep)
    if count < 1 or abs(count * timestep - control_dt) > 1e-6 * control_dt:
        raise UserError(f"control step {control_dt} s is no whole multiple of the model's timestep {timestep} s")
    return count


def _changed(nominal: mjx.Model, model: mjx.Model) -> dict[str, jax.Array]:
    """Leaves of `model` that are not the nominal objects, by dotted name."""
    before, _ = jax.tree_util.tree_flatten_with_path(nominal)
    after = jax.tree.leaves(model)
    if jax.tree.structure(nominal) != jax.tree.structure(model):  # type: ignore[operator]  # jaxlib's stubs
        raise UserError("an effect or parameter changed the structure of the model; only array values may change")
    pairs = zip(before, after, strict=True)
    return {_dotted(path): new for (path, old), new in pairs if new is not old}


def _dotted(path: Sequence[Any]) -> str:
    return jax.tree_util.keystr(tuple(path), simple=True, separator=".")


def _overrides(effect: Effect, hook: str) -> bool:
    return getattr(type(effect), hook) is not getattr(Effect, hook)


class Drive(struct.PyTreeNode):
    """What acts on a world besides its command, all optional.

    Attributes:
        force: `[nv]`, a generalised force of unknown origin.
        enabled: `[nu]`, 1 where the drive is on; 0: the actuator exerts no force at all (open leads).
        law: a controller between the command and the actuators, `laws.Law`.
    """

    force: jax.Array | None = None
    enabled: jax.Array | None = None
    law: Any = None


def forward(
    physics: Physics, model: mjx.Model, data: mjx.Data, carry: Memory, thetas: tuple, seen: Seen, drive: Drive
) -> tuple:
    """`mjx.forward` with the effects' forces added before the acceleration. Returns (data, (memory, forces))."""
    sensors = physics.mj_model.nsensor > 0
    data = mjx.fwd_position(model, data)
    data = mjx.sensor_pos(model, data) if sensors else data
    data = mjx.fwd_velocity(model, data)
    data = mjx.sensor_vel(model, data) if sensors else data
    if drive.law is not None:
        data = data.replace(ctrl=drive.law(data.ctrl, data.qpos, data.qvel, seen))
    data = mjx.fwd_actuation(model, data)
    data, carry = _effect_forces(physics, model, data, carry, thetas, seen, drive)
    data = mjx.fwd_acceleration(model, data)
    if data._impl.efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth), carry
    data = mjx.solve(model, data)
    return (mjx.sensor_acc(model, data) if sensors else data), carry


def _effect_forces(
    physics: Physics, model: mjx.Model, data: mjx.Data, carry: Memory, thetas: tuple, seen: Seen, drive: Drive
) -> tuple:
    """The actuators' forces as the effects change them, and the sum of the effects' own forces in qfrc_applied.

    Each effect sees the newest forces of the others (Gauss-Seidel). They start from those of the last sub-step, so that
    dry friction in several coupled joints settles to sticking.
    """
    if not physics.effects and drive.enabled is None and drive.force is None:
        return data, carry
    memory, forces = list(carry[0]), carry[1]
    step = SubStep(model, data, seen, float(physics.mj_model.opt.timestep))
    each = list(zip(range(len(physics.effects)), physics.effects, physics.sites, strict=True))
    acting = data.actuator_force
    for i, effect, at in each:
        if _overrides(effect, "on_actuator"):
            memory[i], acting = effect.on_actuator(at, memory[i], step, acting, thetas[i])
    if drive.enabled is not None:
        acting = acting * drive.enabled
    if acting is not data.actuator_force:
        # what changed, through the transmission: neutral effects leave qfrc_actuator bit for bit
        change = (acting - data.actuator_force) @ _moment(data)
        data = data.replace(actuator_force=acting, qfrc_actuator=data.qfrc_actuator + change)
    step = SubStep(model, data, seen, float(physics.mj_model.opt.timestep))
    known = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
    outside = jnp.zeros_like(data.qfrc_applied) if drive.force is None else drive.force
    for i, effect, at in each:
        if _overrides(effect, "on_force"):
            others = known + outside + jnp.sum(forces.at[i].set(0.0), axis=0)
            memory[i], force = effect.on_force(at, memory[i], step.seen_by(others, forces[i]), thetas[i])
            forces = forces.at[i].set(force)
    if physics.effects or drive.force is not None:
        data = data.replace(qfrc_applied=jnp.sum(forces, axis=0) + outside)
    return data, (tuple(memory), forces)


def _moment(data: mjx.Data) -> jax.Array:
    return data._impl.actuator_moment


def substep(
    physics: Physics,
    model: mjx.Model,
    data: mjx.Data,
    carry: Memory,
    thetas: tuple,
    seen: Seen,
    drive: Drive = Drive(),  # noqa: B008  # immutable
) -> tuple:
    """One timestep from the state and ctrl in `data`. Returns (data, (memory, forces))."""
    if physics.warp is not None:
        data = physics.warp.step(model, data)
    else:
        data, carry = forward(physics, model, data, carry, thetas, seen, drive)
        integrate = {_EULER: mjx.euler, _RK4: mjx.rungekutta4, _IMPLICITFAST: mjx.implicit}
        data = integrate[int(physics.mj_model.opt.integrator)](model, data)
    if physics.max_qvel is not None:
        data = data.replace(qvel=jnp.clip(data.qvel, -physics.max_qvel, physics.max_qvel))
    return data, carry


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
    warp, thetas = physics.warp, physics.split(world.theta)[1]
    model = physics.model_of(world) if warp is None else warp.model_of(world.fields)
    memory = list(world.memory)
    commands = jnp.broadcast_to(command, (physics.substeps, physics.mj_model.nu))
    each = list(zip(range(len(physics.effects)), physics.effects, physics.sites, strict=True))
    for i, effect, at in each:
        memory[i], commands = effect.on_command(at, memory[i], commands, thetas[i])

    seen = world.measurement | {"error": world.measurement["qpos"] - world.qpos}

    def body(carry: tuple, ctrl: jax.Array) -> tuple[tuple, None]:
        data, remembered = carry
        return substep(physics, model, data.replace(ctrl=ctrl), remembered, thetas, seen, drive), None

    start = (physics.data_of(world, None if warp is None else warp.data), (tuple(memory), world.forces))
    end, _ = body(start, commands[0]) if physics.substeps == 1 else jax.lax.scan(body, start, commands)
    data, (final, forces) = end
    memory, measurement = list(final), {"qpos": data.qpos, "qvel": data.qvel}
    for i, effect, at in each:
        memory[i], measurement = effect.on_measurement(at, memory[i], measurement, thetas[i])
    world = world.replace(
        qpos=data.qpos,
        qvel=data.qvel,
        act=data.act,
        warmstart=data.qacc_warmstart,
        time=data.time,
        memory=tuple(memory),
        forces=forces,
        measurement=measurement,
    )
    return world, data


def begin(physics: Physics, theta: jax.Array, motion: Motion) -> World:
    """A world in the middle of a log: effects' memories filled by the recorded past, sensors' effects undone.

    Args:
        theta: `[d]`; motion: measured, around the start, with the commands before it.
    """
    world = physics.world(theta, motion.qpos[motion.start], motion.qvel[motion.start])
    thetas, memory = physics.split(world.theta)[1], list(world.memory)
    for i in reversed(range(len(physics.effects))):  # sensors come last in a step, so they are undone first
        memory[i], motion = physics.effects[i].on_start(physics.sites[i], memory[i], motion, thetas[i])

    def past(memory: tuple, commands: jax.Array) -> tuple[tuple, None]:
        remembered = list(memory)
        for i, (effect, at) in enumerate(zip(physics.effects, physics.sites, strict=True)):
            remembered[i], commands = effect.on_command(at, remembered[i], commands, thetas[i])
        return tuple(remembered), None

    filled, _ = jax.lax.scan(past, tuple(memory), motion.command[: motion.start])
    return world.replace(qpos=motion.qpos[motion.start], qvel=motion.qvel[motion.start], memory=filled)
