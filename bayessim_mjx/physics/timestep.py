"""One timestep: MJX's own stages in the order of `mjx.step`, the effects between them, and the integrators.

An actuator's force is corrected in one place, `_actuated`, which every stage of every integrator goes through: effects,
then drives that are off, then gravity compensation and the joint's limit (`actuatorfrcrange`), in MuJoCo's order.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.support.site import joint_dofs, ranges
from bayessim_mjx.effects.support.substep import SubStep, springs
from bayessim_mjx.linalg import inverse, product
from bayessim_mjx.physics.controllers import Drive
from bayessim_mjx.physics.gates import chained_in
from bayessim_mjx.physics.model import EULER, IMPLICITFAST, RK4, Physics
from bayessim_mjx.physics.pushed import Memory, pushed
from bayessim_mjx.physics.staged import Staged

# of RK4 after the first: how far from the start, weight, and by what share of a command's slope over the timestep its
# command is another than the mean: so positions and velocities move as by the slope, and the first stage has the mean
STAGES = ((0.5, 1 / 3, -0.25), (0.5, 1 / 3, -0.25), (1.0, 1 / 6, 1.0))
_NO_DAMPING = int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)


@dataclasses.dataclass(frozen=True, eq=False)
class Timestep:
    """What does not change during one timestep of one world.

    Attributes:
        physics: static.
        model: with the world's parameters.
        thetas: one slice per effect.
        seen: what the sensors showed after the last control step, {"qpos", "qvel"}.
        drive: what else acts.
        slope: `[nu]`, by how much ctrl changes over the timestep, linear about its mean; None: not at all.
    """

    physics: Physics
    model: mjx.Model
    thetas: tuple[jax.Array, ...]
    seen: dict[str, jax.Array]
    drive: Drive
    slope: jax.Array | None = None

    def having(self, hook: str) -> list[tuple]:
        """(index, effect, site, slice of theta) of the effects that have this hook."""
        physics = self.physics
        return [(i, physics.effects[i], physics.sites[i], self.thetas[i]) for i in physics.having(hook)]

    def view(self, data: mjx.Data, **known: Any) -> SubStep:
        """Return the timestep as effects see it."""
        time = self.model.opt.timestep  # an argument of the program where errors of the time step are measured
        dt = time if isinstance(time, jax.core.Tracer) else float(self.physics.mj_model.opt.timestep)
        return SubStep(self.model, data, self.seen, dt, **known)

    @property
    def corrected(self) -> bool:
        """Whether anything may change the actuators' forces."""
        return self.drive.enabled is not None or bool(self.having("on_actuator"))


def substep(
    physics: Physics,
    model: mjx.Model,
    data: mjx.Data,
    carry: Memory,
    thetas: tuple[jax.Array, ...],
    seen: dict[str, jax.Array],
    drive: Drive = Drive(),  # noqa: B008  # immutable
    slope: jax.Array | None = None,
) -> tuple[mjx.Data, Memory]:
    """One timestep from the state and ctrl in `data`. Returns (data, (memory, forces)).

    The state in data is the new one; its poses, contacts, forces and sensors are those of the timestep's beginning.

    Args:
        physics: static.
        model: with the world's parameters.
        data: the state, and ctrl `[nu]`.
        carry: the effects' memories, and the last timestep's forces `[nv]` of those that exert any (`pushed.apart`).
        thetas: one slice per effect.
        seen: what the sensors showed after the last control step, {"qpos", "qvel"}.
        drive: what else acts; slope: see `Timestep`.
    """
    if physics.warp is not None:
        data = physics.warp.step(model, data)
    else:
        own, memory = Timestep(physics, model, thetas, seen, drive, slope), carry[0]
        data, carry, step = forward(own, data, carry)
        data, carry = _integrated(own, data, memory, carry, step)
    if physics.max_qvel is not None:
        data = data.replace(qvel=jnp.clip(data.qvel, -physics.max_qvel, physics.max_qvel))
    return data, carry


def forward(own: Timestep, data: mjx.Data, carry: Memory) -> tuple[mjx.Data, Memory, SubStep]:
    """`mjx.forward` and what effects and drives add to it. Returns (data, (memory, forces), the timestep as seen)."""
    physics, model = own.physics, own.model
    sensors = physics.mj_model.nsensor > 0
    data = mjx.fwd_position(model, data)
    data = mjx.sensor_pos(model, data) if sensors else data
    data = mjx.fwd_velocity(model, data)
    data = mjx.sensor_vel(model, data) if sensors else data
    if own.drive.law is not None:
        seen = physics.encoders(own.thetas, carry[0], data.qpos, data.qvel, own.drive.active)
        law = own.drive.law
        for _, effect, site, theta in own.having("on_law"):
            law = effect.on_law(site, law, theta)
        data = data.replace(ctrl=law(data.ctrl, *seen))
    data, memory, step = _actuated(own, data, carry[0])
    data, carry = pushed(physics, own.thetas, own.drive, data, (memory, carry[1]), step)
    data = _accelerated(model, data)
    return (mjx.sensor_acc(model, data) if sensors and data._impl.efc_J.size else data), carry, step


def _accelerated(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    data = mjx.fwd_acceleration(model, data)
    if data._impl.ne and data._impl.ne == data._impl.nefc:
        return _bound(model, data)
    return mjx.solve(model, data) if data._impl.efc_J.size else data.replace(qacc=data.qacc_smooth)


def _bound(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Return the accelerations where equality constraints are all there is, which is linear: no solver has to iterate.

    The second solution is of what rounding left of the first.
    """
    stiff, pull = springs(data)
    matrix, wanted = mjx.full_m(model, data) + stiff, data.qfrc_smooth + pull
    solution = inverse(matrix)
    qacc = product(solution, wanted)
    qacc = qacc + product(solution, wanted - product(matrix, qacc))
    force = data._impl.efc_D * (data._impl.efc_aref - product(data._impl.efc_J, qacc))
    exerted = product(data._impl.efc_J.T, force)
    return data.tree_replace({"qacc": qacc, "qfrc_constraint": exerted, "_impl.efc_force": force})


def _actuated(own: Timestep, data: mjx.Data, memory: tuple) -> tuple[mjx.Data, tuple, SubStep]:
    """Return the actuators' forces as effects and drives leave them. Returns (data, memory, the timestep as seen)."""
    model, before = own.model, memory
    data = plain = mjx.fwd_actuation(model, data.replace(ctrl=_within_range(own, data.ctrl)))
    if not model.nu or int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_ACTUATION):
        return data, memory, own.view(data)
    if own.corrected:
        memory, acting = _acting(own, own.view(plain), memory, plain.actuator_force)
        data = data.replace(actuator_force=acting, qfrc_actuator=_torque(own, plain, acting))
    return data, memory, own.view(data, response=lambda: _response(own, plain, data.actuator_force, before))


def _within_range(own: Timestep, ctrl: jax.Array) -> jax.Array:
    """ctrl inside its range where the integrator's derivative needs it so: that of MJX takes it as it is given."""
    model = own.physics.mj_model
    grows = model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_AFFINE)
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL)
    if off or int(model.opt.integrator) != IMPLICITFAST or not np.any(grows & (model.actuator_ctrllimited > 0)):
        return ctrl
    return jnp.clip(ctrl, *ranges(own.model.actuator_ctrllimited, own.model.actuator_ctrlrange))


def _acting(own: Timestep, step: SubStep, memory: tuple, force: jax.Array) -> tuple[tuple, jax.Array]:
    """(memory, forces `[nu]`) behind all effects on actuators, and where the drive is on."""
    physics, step = own.physics, step if own.drive.active is None else step.ready("asked")

    def hook(i: int, remembered: Any, force: jax.Array) -> tuple[Any, jax.Array]:
        return physics.effects[i].on_actuator(physics.sites[i], remembered, step, force, own.thetas[i])

    memory, force = chained_in(own.drive.active, physics.having("on_actuator"), hook, memory, force)
    return memory, force if own.drive.enabled is None else force * own.drive.enabled


def _torque(own: Timestep, plain: mjx.Data, acting: jax.Array) -> jax.Array:
    """Generalised force `[nv]` of the actuators, gravity compensation included, within the joints' limits.

    Where nothing changed it is MJX's own number, bit for bit; its derivative is that of the changed force either way.
    """
    model, enabled = own.model, own.drive.enabled
    torque = jnp.clip(_unclipped(own, plain, acting), *_joint_ranges(model))
    same = jnp.all(acting == plain.actuator_force)
    if enabled is not None:
        same &= jnp.all(enabled == 1)
    value = jax.lax.stop_gradient(jnp.where(same, plain.qfrc_actuator, torque))
    return value + (torque - jax.lax.stop_gradient(torque))


def _unclipped(own: Timestep, data: mjx.Data, acting: jax.Array) -> jax.Array:
    model, moment, enabled = own.model, data._impl.actuator_moment, own.drive.enabled
    torque = acting @ moment
    if not model.flg_gravcomp or not np.any(model.jnt_actgravcomp):
        return torque
    compensation = data.qfrc_gravcomp * model.jnt_actgravcomp[model.dof_jntid]
    if enabled is not None:
        reached = moment != 0
        powered = jnp.max(jnp.where(reached, enabled[:, None], 0.0), axis=0)
        compensation = compensation * jnp.where(jnp.any(reached, axis=0), powered, 1.0)
    return torque + compensation


def _joint_ranges(model: mjx.Model) -> tuple[jax.Array, jax.Array]:
    return ranges(model.jnt_actfrclimited[model.dof_jntid], model.jnt_actfrcrange[model.dof_jntid])


def _response(own: Timestep, plain: mjx.Data, acting: jax.Array, memory: tuple) -> jax.Array | None:
    """How much of a change of its damping force an actuator passes on, `[nu]`; None: all of it, always.

    0 at a limit of the actuator or of its joint, as in MuJoCo's own derivative (MJX has none), and where it is off.
    """
    model, nominal = own.model, own.physics.mj_model
    limited = np.any(nominal.actuator_forcelimited), np.any(nominal.jnt_actfrclimited)
    if not own.corrected and not any(limited):
        return None
    low, high = ranges(model.actuator_forcelimited, model.actuator_forcerange)
    response = ((plain.actuator_force > low) & (plain.actuator_force < high)).astype(acting.dtype)
    if own.corrected:

        def chain(force: jax.Array, asked: jax.Array) -> jax.Array:
            return _acting(own, own.view(plain.replace(actuator_force=force), asked=asked), memory, force)[1]

        forces = plain.actuator_force, own.view(plain).asked
        response = jax.jvp(chain, forces, (response, jnp.ones_like(response)))[1]
    if not limited[1]:
        return response
    low, high = _joint_ranges(model)
    torque, dof = _unclipped(own, plain, acting), joint_dofs(nominal)
    return response * jnp.where(dof >= 0, ((torque > low) & (torque < high))[dof], True)


def _integrated(own: Timestep, data: mjx.Data, memory: tuple, carry: Memory, step: SubStep) -> tuple[mjx.Data, Memory]:
    """Return the state at the end of the timestep; memory: of the effects, as it was at its beginning."""
    integrator = int(own.physics.mj_model.opt.integrator)
    if integrator == RK4:
        return _rk4(own, data, memory, carry)
    data = _in_turn(data)
    return mjx.euler(own.model, data) if integrator == EULER else mjx.implicit(step.solved, data), carry


def _in_turn(data: mjx.Data) -> mjx.Data:
    """Return the same numbers, the inertia only once the acceleration is known: the integrators factor a second matrix.

    On a CPU two of LAPACK's batched factorisations at once can wait for each other for ever (linalg.py).
    """
    inertia = getattr(data._impl, "M", None)
    known = inertia is not None and data.qacc.size
    return data.tree_replace({"_impl.M": inertia + 0.0 * data.qacc[0]}) if known else data


def _inside(own: Timestep, ctrl: jax.Array, slope: jax.Array) -> jax.Array:
    """Return the slope, no steeper than stages inside ctrlrange allow: what MuJoCo clips there is lost to the mean."""
    low, high = ranges(own.model.actuator_ctrllimited, own.model.actuator_ctrlrange)
    up, down = jnp.maximum(high - ctrl, 0.0), jnp.minimum(low - ctrl, 0.0)
    return jnp.clip(slope, jnp.maximum(down, -4 * up), jnp.minimum(up, -4 * down))


def _rk4(own: Timestep, first: mjx.Data, memory: tuple, carry: Memory) -> tuple[mjx.Data, Memory]:
    """Return the classical Runge-Kutta method of fourth order, from its first stage.

    Actuators' forces are corrected in every stage, from the same memory: what effects remember is of the first one.
    Held over the timestep are the controller's output (but for the slope of commands), the effects' own forces (their
    friction is that of its end already) unless they have `rates`, and the torque of actuators that act through an
    effect (`Effect.transmits`).
    """
    model, dt = own.model, own.model.opt.timestep
    slope_of_ctrl = None if own.slope is None else _inside(own, first.ctrl, own.slope)
    flags = mjx.DisableBit(int(model.opt.disableflags) | _NO_DAMPING)
    forcing = own.physics.having("on_force")
    staged = Staged(own.having("rates"), own.drive.active, own.view, forcing, first, carry)

    def moved(slope: tuple[Any, ...], time: jax.Array) -> mjx.Data:
        """`time` after the beginning, at this velocity and rate of the activations; qvel is not moved."""
        # MJX's own steps, quaternions and activations come with Euler's method: at no acceleration it goes along qvel
        straight = model.tree_replace({"opt.timestep": time, "opt.disableflags": flags})
        velocity, acceleration, rate, _ = slope
        along = first.replace(qvel=velocity, qacc=jnp.zeros_like(acceleration), act_dot=rate)
        return mjx.euler(straight, along)

    def stage(carry: tuple, row: jax.Array) -> tuple[tuple, None]:
        total, slope = carry
        time = row[0] * dt
        act, qvel = first.act + time * slope[2], first.qvel + time * slope[1]
        data = first.replace(qpos=moved(slope, time).qpos, qvel=qvel, act=act, time=first.time + time)
        if slope_of_ctrl is not None:
            data = data.replace(ctrl=first.ctrl + row[2] * slope_of_ctrl)
        data = mjx.fwd_velocity(model, mjx.fwd_position(model, data))
        data, _, _ = _actuated(own, data, memory)
        for _, effect, at, theta in own.having("transmits"):
            torque = jnp.where(effect.transmits(at, theta), first.qfrc_actuator, data.qfrc_actuator)
            data = data.replace(qfrc_actuator=torque)
        data, rates = staged.pushed(data, slope[3], time)
        data = _accelerated(model, data)
        slope = (qvel, data.qacc, data.act_dot, rates)
        return (jax.tree.map(lambda t, s: t + row[1] * s, total, slope), slope), None

    start = (first.qvel, first.qacc, first.act_dot, staged.first)
    total, last = jax.lax.scan(stage, (jax.tree.map(lambda x: x / 6, start), start), jnp.asarray(STAGES))[0]
    end = moved(total, dt)
    data = first.replace(
        qpos=end.qpos, qvel=first.qvel + dt * total[1], act=end.act, time=end.time, qacc_warmstart=last[1]
    )
    return data, (staged.memory(total[3], dt), carry[1])
