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

from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.parameters import ParameterSpace

_EULER, _RK4, _IMPLICITFAST = (
    int(getattr(mujoco.mjtIntegrator, f"mjINT_{n}")) for n in ("EULER", "RK4", "IMPLICITFAST")
)

Memory = tuple[tuple, jax.Array]  # (memories of the effects, their last forces [effects, nv])


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
            raise ValueError(f"integrator {mj_model.opt.integrator}: MJX has Euler, RK4 and implicitfast")
        self.max_qvel = None if max_qvel is None else np.broadcast_to(np.asarray(max_qvel, np.float32), (mj_model.nv,))
        self.model = mjx.put_model(mj_model, impl="jax")
        self.template = mjx.make_data(mj_model, impl="jax")
        self._memory = tuple(effect.init(self) for effect in self.effects)

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
        for effect, part in zip(self.effects, slices, strict=True):
            model = effect.on_model(model, part)
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

    def data_of(self, world: World) -> mjx.Data:
        """`mjx.Data` in this world's state; everything derived from the state is the template's (not this state's)."""
        return self.template.replace(
            qpos=world.qpos, qvel=world.qvel, act=world.act, qacc_warmstart=world.warmstart, time=world.time
        )

    def kinematics(self, world: World) -> mjx.Data:
        """`mjx.Data` with the poses and velocities of all bodies in this world's state; no contacts, no forces."""
        model, data = self.model_of(world), self.data_of(world)
        return mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))


def _substeps(control_dt: float, timestep: float) -> int:
    count = round(control_dt / timestep)
    if count < 1 or abs(count * timestep - control_dt) > 1e-6 * control_dt:
        raise ValueError(f"control step {control_dt} s is no whole multiple of the model's timestep {timestep} s")
    return count


def _changed(nominal: mjx.Model, model: mjx.Model) -> dict[str, jax.Array]:
    """Leaves of `model` that are not the nominal objects, by dotted name."""
    before, _ = jax.tree_util.tree_flatten_with_path(nominal)
    after = jax.tree.leaves(model)
    if jax.tree.structure(nominal) != jax.tree.structure(model):  # type: ignore[operator]  # jaxlib's stubs
        raise ValueError("an effect or parameter changed the structure of the model; only array values may change")
    pairs = zip(before, after, strict=True)
    return {_dotted(path): new for (path, old), new in pairs if new is not old}


def _dotted(path: Sequence[Any]) -> str:
    return jax.tree_util.keystr(tuple(path), simple=True, separator=".")


def _overrides(effect: Effect, hook: str) -> bool:
    return getattr(type(effect), hook) is not getattr(Effect, hook)


def forward(physics: Physics, model: mjx.Model, data: mjx.Data, carry: Memory, thetas: tuple) -> tuple:
    """`mjx.forward` with the effects' forces added before the acceleration. Returns (data, (memory, forces))."""
    sensors = physics.mj_model.nsensor > 0
    data = mjx.fwd_position(model, data)
    data = mjx.sensor_pos(model, data) if sensors else data
    data = mjx.fwd_velocity(model, data)
    data = mjx.sensor_vel(model, data) if sensors else data
    data = mjx.fwd_actuation(model, data)
    data, carry = _effect_forces(physics, model, data, carry, thetas)
    data = mjx.fwd_acceleration(model, data)
    if data._impl.efc_J.size == 0:
        return data.replace(qacc=data.qacc_smooth), carry
    data = mjx.solve(model, data)
    return (mjx.sensor_acc(model, data) if sensors else data), carry


def _effect_forces(physics: Physics, model: mjx.Model, data: mjx.Data, carry: Memory, thetas: tuple) -> tuple:
    """Sum of the effects' forces in qfrc_applied; each effect sees the newest forces of the others (Gauss-Seidel).

    Forces start from those of the last sub-step, so that dry friction in several coupled joints settles to sticking.
    """
    memory, forces = list(carry[0]), carry[1]
    for i, effect in enumerate(physics.effects):
        if _overrides(effect, "on_force"):
            others = data.replace(qfrc_applied=jnp.sum(forces.at[i].set(0.0), axis=0))
            memory[i], force = effect.on_force(memory[i], model, others, thetas[i])
            forces = forces.at[i].set(force)
    if physics.effects:
        data = data.replace(qfrc_applied=jnp.sum(forces, axis=0))
    return data, (tuple(memory), forces)


def substep(physics: Physics, model: mjx.Model, data: mjx.Data, carry: Memory, thetas: tuple) -> tuple:
    """One timestep from the state and ctrl in `data`. Returns (data, (memory, forces))."""
    data, carry = forward(physics, model, data, carry, thetas)
    integrate = {_EULER: mjx.euler, _RK4: mjx.rungekutta4, _IMPLICITFAST: mjx.implicit}
    data = integrate[int(physics.mj_model.opt.integrator)](model, data)
    if physics.max_qvel is not None:
        data = data.replace(qvel=jnp.clip(data.qvel, -physics.max_qvel, physics.max_qvel))
    return data, carry


def control_step(physics: Physics, world: World, command: jax.Array) -> tuple[World, mjx.Data]:
    """Advance one world by one control step.

    Args:
        physics: static.
        world: the state.
        command: `[nu]`, in the units of the actuators' ctrl; MuJoCo clips it to ctrlrange where ctrllimited.

    Returns:
        (world after the step, `mjx.Data` of the last sub-step: its state is the new one; its poses, contacts and forces
        are those computed *before* the last integration, as after `mjx.step`).
    """
    with jax.default_matmul_precision("highest"):  # a GPU would round the inputs of its products to TF32
        return _control_step(physics, world, command)


def _control_step(physics: Physics, world: World, command: jax.Array) -> tuple[World, mjx.Data]:
    model, thetas = physics.model_of(world), physics.split(world.theta)[1]
    memory = list(world.memory)
    commands = jnp.broadcast_to(command, (physics.substeps, physics.mj_model.nu))
    for i, effect in enumerate(physics.effects):
        memory[i], commands = effect.on_command(memory[i], commands, thetas[i])

    def body(carry: tuple, ctrl: jax.Array) -> tuple[tuple, None]:
        data, remembered = carry
        return substep(physics, model, data.replace(ctrl=ctrl), remembered, thetas), None

    start = (physics.data_of(world), (tuple(memory), world.forces))
    end, _ = body(start, commands[0]) if physics.substeps == 1 else jax.lax.scan(body, start, commands)
    data, (final, forces) = end
    memory, measurement = list(final), {"qpos": data.qpos, "qvel": data.qvel}
    for i, effect in enumerate(physics.effects):
        memory[i], measurement = effect.on_measurement(memory[i], measurement, thetas[i])
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
