"""Motor and link as two inertias with something soft or loose between them, shared by the transmission effects.

The joint of the model is the link. The motors of the site's joints live in the effect's memory: `twist`, motor angle
less link angle, and `speed`, the motors' velocity. Both sides are solved together at the end of the sub-step, so that a
stiff transmission tends to the rigid joint of the model and no stiffness is unstable. Position servos close their loop
on the motor's side, where their encoder is. The joint's damping is the motor's too: bearings and seals that turn
with the reduction's square count there.
"""

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.quantity import Quantity
from bayessim_mjx.effects.support.site import Site, joint_dofs, ranges, staggered
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    from mujoco import mjx

Measurement: TypeAlias = dict[str, jax.Array]  # {"qpos": [nq], "qvel": [nv]}
SHARE = 0.2  # of the joint's inertia is the motor's where the model has no armature
FOX_GOODWIN = 1 / 12  # of the sub-step, what the slip at its end adds to the mean way; 1/4: implicit midpoint rule
REAL = 2.0**-10  # armature below this part of the joint's inertia counts as none
_EULER = int(mujoco.mjtIntegrator.mjINT_EULER)
_IMPLICIT = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)


def start(at: Site) -> dict[str, jax.Array]:
    """Memory at the start; `fresh`: the first sub-step is rigid and shows where the load leaves the motor.

    `origin`: by how much the simulated link is ahead of the true one, so that an encoder on the motor shows from the
    first what was recorded there; only gravity notices. A recording that leads up to the start takes it away.
    """
    none = jnp.zeros(len(at))
    return {"twist": none, "speed": none, "origin": none, "fresh": jnp.ones((), bool)}


def split(at: Site, model: "mjx.Model", on: jax.Array, mark: float) -> "mjx.Model":
    """Take the armature off the links where `on` `[n]`: it is the motors'.

    The hooks of the sub-step must find it again, with parameters written into it, and have no other place for a number
    of the episode than the model: it stays there times `mark`, a power of 2 that makes it weigh nothing.
    """
    armature = model.dof_armature[at.dadr]
    taken = on & (armature > REAL * model.dof_M0[at.dadr])
    return model.replace(dof_armature=model.dof_armature.at[at.dadr].set(jnp.where(taken, mark * armature, armature)))


def follow(at: Site, memory: Any, qvel: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(twist, slip), `[n]`: motor less link, now; the link moved as the whole simulation let it."""
    slip = jnp.where(memory["fresh"], 0.0, memory["speed"] - qvel[at.dadr])
    share = 1.0 if staggered(at.mj_model) else 0.5  # as the links move: by the new velocities, or by the mean
    return memory["twist"] + share * at.mj_model.opt.timestep * slip, slip


def servos(at: Site) -> tuple[np.ndarray, np.ndarray]:
    """(ids of the actuators with feedback from joints of the site, their places in it)."""
    model, dof = at.mj_model, joint_dofs(at.mj_model)
    affine = model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_AFFINE)
    ids = np.flatnonzero(affine & np.isin(dof, at.dadr))
    return ids, np.asarray([int(np.flatnonzero(at.dadr == dof[i])[0]) for i in ids], int)


def feedback(at: Site, memory: Any, step: SubStep, force: jax.Array, on: jax.Array) -> jax.Array:
    """Actuator forces `[nu]` with the servos' feedback taken from the motors instead of the links."""
    ids, places = servos(at)
    if not len(ids):
        return force
    model = step.model
    twist, slip = (x[places] for x in follow(at, memory, step.qvel))
    twist = twist - memory["origin"][places]
    if not staggered(at.mj_model):  # its link stands where the sub-step begins, the motor at its middle
        twist = twist + 0.5 * step.dt * step.qvel[at.dadr[places]]
    gear, bias = model.actuator_gear[ids, 0], model.actuator_biasprm[ids]
    extra = gear * (bias[:, 1] * twist + bias[:, 2] * slip)
    low, high = ranges(model.actuator_forcelimited[ids], model.actuator_forcerange[ids])
    own = step.data.actuator_force[ids]
    inside = jnp.where((own > low) & (own < high), own, step.asked[ids])
    change = jnp.clip(inside + extra, low, high) - own
    return force.at[ids].add(jnp.where(on[places], change, 0.0))


class Sides(NamedTuple):
    """Motors and links of a sub-step before anything passes between them, `[n]` each; on: the effect is active there.

    twist, slip: motor less link, angle and velocity; torque: the actuators' less the joint's damping, on the motor;
    lost: the same as a rigid joint's link has it; motor: its inertia; kp, kv: the servos' feedback that follows the
    motor within the sub-step, and damping; inside: what of the matrix that the integrator solves is not the link's
    (damping of servos and joint, the motor's share), kg m^2; damped: damping that follows the motor's own velocity, so
    the link's too; series: inertia of motor against link; inertia `[n, n]`: of the links, as felt at the joints, with
    `inside`; push: impulse of all other forces on the links.
    """

    on: jax.Array
    twist: jax.Array
    slip: jax.Array
    torque: jax.Array
    lost: jax.Array
    motor: jax.Array
    kp: jax.Array
    kv: jax.Array
    inside: jax.Array
    damped: jax.Array
    beside: jax.Array
    series: jax.Array
    inertia: jax.Array
    push: jax.Array


def sides(at: Site, memory: Any, step: SubStep, on: jax.Array, mark: float) -> Sides:
    """Both sides of the site's joints in this sub-step; `mark` as in `split`."""
    model, dof, dt = step.model, at.dadr, step.dt
    torque = jnp.where(on, step.data.qfrc_actuator[dof], 0.0)
    kp, kv = _gains(at, step, on)
    mobility = step.inverse[np.ix_(dof, dof)]
    inertia = inverse(mobility)
    drag = jnp.where(on, model.dof_damping[dof], 0.0)
    servo = dt * kv if int(at.mj_model.opt.integrator) == _IMPLICIT else jnp.zeros(len(at))
    solved = servo + (dt * drag if _solves_damping(at) else 0.0)
    damped, kv, beside = servo + dt * drag, kv + drag, jnp.zeros(len(at))
    alone = inverse(inertia - jnp.diag(solved))
    felt = 1.0 / jnp.diagonal(alone)
    part = min(SHARE, 0.8 / len(at))  # trace bound: what the motors leave stays positive definite
    armature = model.dof_armature[dof] / mark
    whole = model.dof_M0[dof]
    own = (armature > REAL * whole) & (armature < whole / REAL)
    motor, link = jnp.where(own, armature, part * felt), jnp.where(own, felt, (1 - part) * felt)
    if not staggered(at.mj_model):  # damping at the mean speed of the sub-step, where that resolves it
        kv = kv * (1.0 - 0.5 * jnp.minimum(1.0, motor / jnp.where(kv > 0, dt * kv, motor)))
        damped, beside = dt * kv, 0.5 * drag
    lost = torque - drag * step.qvel[dof]
    free = step.dt * (step.inverse[dof] * (step.force - at.scatter(lost))).sum(-1)
    twist, slip = follow(at, memory, step.qvel)
    slip = jnp.where(on, slip, 0.0)
    return Sides(
        on=on,
        twist=jnp.where(on, twist, 0.0),
        slip=slip,
        torque=lost - drag * slip,
        lost=lost,
        motor=motor,
        kp=kp,
        kv=kv,
        inside=jnp.where(on, solved + jnp.where(own, 0.0, motor), 0.0),
        damped=damped,
        beside=beside,
        series=motor * link / (motor + link),
        inertia=inertia,
        push=(inertia * free).sum(-1),
    )


def _solves_damping(at: Site) -> bool:
    """Whether the joints' damping is in the matrix that the integrator solves."""
    option = at.mj_model.opt
    euler = int(option.integrator) == _EULER and not option.disableflags & int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
    return bool(euler) or int(option.integrator) == _IMPLICIT


def _gains(at: Site, step: SubStep, on: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(kp, kv) of the servos as far as they respond, at the joints `[n]`; MuJoCo's matrix holds this kv too."""
    ids, places = servos(at)
    none = jnp.zeros(len(at))
    if not len(ids):
        return none, none
    own = step.response[ids] * step.model.actuator_gear[ids, 0] ** 2
    gains = (-own * step.model.actuator_biasprm[ids, k] for k in (1, 2))
    kp, kv = (jnp.where(on, jnp.maximum(none.at[places].add(g), 0.0), 0.0) for g in gains)
    return kp, kv


def recorded(
    at: Site, memory: Any, before: Measurement, after: Measurement, on: jax.Array, encoder: jax.Array
) -> tuple[dict[str, jax.Array], Measurement]:
    """Set what the encoder sees to where it was recorded, and move the other side along with it.

    So a recording gives the motion of both, with its noise, and simulation the one of motors against links. An encoder
    on the motor says nothing of the link's speed: the link keeps its own.
    """
    dof, known = at.dadr, on & ~memory["fresh"]
    motors = jnp.where(known, encoder, 0.0)
    along = after["qvel"][dof] - before["qvel"][dof]
    speed = memory["speed"] + along + motors * (before["qvel"][dof] - memory["speed"])
    memory = {**memory, "speed": jnp.where(known, speed, memory["speed"])}
    qvel = after["qvel"].at[dof].add(-motors * along)
    twist, _ = follow(at, memory, qvel)
    qpos = after["qpos"].at[at.qadr].add(-motors * twist)
    return {**memory, "origin": jnp.where(known, 0.0, memory["origin"])}, {"qpos": qpos, "qvel": qvel}


def shown(at: Site, memory: Any, measurement: Measurement, on: jax.Array, encoder: jax.Array) -> Measurement:
    """Return what encoders show that are on the motors (`encoder` 1), on the links (0) or between."""
    twist, slip = follow(at, memory, measurement["qvel"])
    qpos = measurement["qpos"].at[at.qadr].add(jnp.where(on, encoder * twist - memory["origin"], 0.0))
    return {"qpos": qpos, "qvel": measurement["qvel"].at[at.dadr].add(jnp.where(on, encoder * slip, 0.0))}


def moved(
    at: Site, memory: Any, ahead: Measurement, state: Measurement, on: jax.Array, encoder: jax.Array
) -> tuple[dict[str, jax.Array], Measurement]:
    """Move motors further ahead of their links, and whichever of both the encoder does not see."""
    twist, slip = (jnp.where(on, ahead[what][at.dadr], 0.0) for what in ("qpos", "qvel"))
    memory = {**memory, "twist": memory["twist"] + twist, "speed": memory["speed"] + (1.0 - encoder) * slip}
    qpos = state["qpos"].at[at.qadr].add(-encoder * twist)
    return memory, {"qpos": qpos, "qvel": state["qvel"].at[at.dadr].add(-encoder * slip)}


class Passed(NamedTuple):
    """At the end of a sub-step, `[n]`: torque through the transmission, change of the links' speed, motor's slip."""

    torque: jax.Array
    change: jax.Array
    slip: jax.Array


class Spring(NamedTuple):
    """s of `transmit`, `[n]` each: soft s = (twist - rest) + ahead slip + over slip', looked at in the sub-step.

    slip, slip': at its beginning and end; late, before: the part of `over` and `ahead` that is way; share: of slip' in
    the sub-step's way.
    """

    soft: jax.Array
    late: jax.Array
    over: jax.Array
    before: jax.Array
    ahead: jax.Array
    share: jax.Array


def sprung(at: Site, both: Sides, dt: float | jax.Array, soft: jax.Array, ratio: jax.Array | float) -> Spring:
    """Return springs of compliance `soft` 1/k `[n]`, damped by `ratio` of critical.

    A resolved spring is looked at where the sub-step begins, which costs no energy. By RK4, which has a state's numbers
    all at one time, its mean is taken so that the frequency is right to the fourth order (Fox and Goodwin, 1949). A
    stiff one is looked at where it ends.
    """
    period = jnp.where(both.on, soft * both.series, 0.0)  # J_s / k
    root = jnp.sqrt(jnp.where(period > 0, period, 1.0))
    loss = jnp.where(period > 0, 2 * ratio * root, 0.0)  # d / k = 2 zeta sqrt(J_s / k)
    squares = period / (dt**2 * (1 + period * both.kp / both.motor))
    if staggered(at.mj_model):
        late = dt * jnp.maximum(1.0 - squares, 0.0)
        none = jnp.zeros(len(at))
        return Spring(soft, late, late + loss, none, none, none + 1.0)
    stiff = jnp.maximum(1.0 - 4.0 * squares, 0.0)  # resolved up to omega dt = 2: it damps beyond
    share, late = 0.5 * (1.0 + stiff), dt * (FOX_GOODWIN + (1.0 - FOX_GOODWIN) * stiff)
    before = dt * (0.5 - FOX_GOODWIN) * (1.0 - stiff)
    return Spring(soft, late, late + share * loss, before, before + (1.0 - share) * loss, share)


def transmit(both: Sides, dt: float | jax.Array, spring: Spring, rest: jax.Array, held: jax.Array) -> Passed:
    """Solve motors and links together where `held` `[n]`; elsewhere nothing passes between them."""
    # motor: J (w' - w) = dt (tau - s - kp (late slip' + ahead of it) - kv (slip' - slip) - damped (v' - v) / dt)
    late, over, before = spring.late, spring.over, spring.before
    slow = both.motor + dt * late * both.kp + dt * both.kv
    rigid = both.motor + both.damped
    drive = dt * both.torque + (both.motor + dt * both.kv - dt * before * both.kp) * both.slip
    below = jnp.where(held, slow * spring.soft + dt * over, 1.0)
    gain = jnp.where(held, over / below, 0.0)
    wound = both.twist + spring.ahead * both.slip - rest
    pull = jnp.where(held, (over * drive + slow * wound) / below, 0.0)
    # link: Y (v' - v) = push + dt s, with s = pull - gain rigid (v' - v)
    matrix = both.inertia + jnp.diag(dt * gain * rigid - both.inside)
    change = (inverse(matrix) * (both.push + dt * pull)).sum(-1)
    torque = pull - gain * rigid * change
    return Passed(torque, change, (drive - dt * torque - rigid * change) / slow)


def finish(
    at: Site,
    memory: Any,
    step: SubStep,
    both: Sides,
    passed: Passed,
    twist: jax.Array,
    share: jax.Array,
    encoder: jax.Array | None,
) -> tuple[dict, jax.Array]:
    """(memory, generalised force `[nv]`): the link gets what passed instead of what the actuators exert.

    twist: where the sub-step begins; memory: so far; share: of the slip at its end in the way (`Spring`); encoder: see
    `shown`.
    """
    own = passed.torque + (both.inside / step.dt + both.beside) * passed.change - both.lost
    speed = step.qvel[at.dadr] + passed.change + jnp.where(both.on, passed.slip, 0.0)
    twist, origin = jnp.where(both.on, twist, 0.0), memory["origin"]
    if encoder is not None:
        origin = jnp.where(memory["fresh"], encoder * twist, origin)
    if not staggered(at.mj_model):  # `follow` adds half a sub-step's way at the slip that the simulation ends with
        way = step.dt * ((1.0 - share) * both.slip + (share - 0.5) * passed.slip)
        twist = twist + jnp.where(both.on, way, 0.0)
    memory = {"twist": twist, "speed": speed, "origin": origin, "fresh": jnp.zeros((), bool)}
    return memory, at.scatter(jnp.where(both.on, own, 0.0))


def inverse(matrix: jax.Array) -> jax.Array:
    """Inverse of a positive definite matrix `[n, n]`, by Gauss-Jordan: small, and needs no pivots."""
    size = matrix.shape[0]

    def step(k: jax.Array, a: jax.Array) -> jax.Array:
        here = jnp.arange(size) == k
        row, column = jnp.sum(a * here[:, None], axis=0), jnp.sum(a * here, axis=1)
        row = jnp.where(here, 1.0, row) / jnp.sum(row * here)
        rest = jnp.where(here, 0.0, a) - column[:, None] * row
        return jnp.where(here[:, None], row, rest)

    return 1.0 / matrix if size == 1 else jax.lax.fori_loop(0, size, step, matrix)


# where the encoder sits between the link (0) and the motor (1)
ENCODER = Quantity("encoder", 0.0, 0.0, 1.0, grid=(0.0, 1.0), shape=True, optional=True)


class OfTransmission:
    """What effects on a transmission share.

    `mark`: see `split`. The first parameter is above 0 where there is one; the last may be `ENCODER`.
    """

    mark: ClassVar[float]
    follows: ClassVar[bool] = True
    quantities: ClassVar[tuple[Quantity, ...]]

    def encoder(self, at: Site, theta: jax.Array) -> jax.Array | None:
        """`[n]`, see `shown`; None: on the link."""
        return at.values(theta)[:, -1] if self.quantities[-1] is ENCODER else None

    def on(self, at: Site, theta: jax.Array) -> jax.Array:
        """`[n]` bool, joints that have one."""
        return at.values(theta)[:, 0] > 0

    def init(self, at: Site) -> Any:
        return start(at)

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        return split(at, model, self.on(at, theta), self.mark)

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        return memory, feedback(at, memory, step, force, self.on(at, theta))

    def on_record(
        self, at: Site, memory: Any, before: Measurement, after: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        return recorded(at, memory, before, after, self.on(at, theta), self._encoder(at, theta))

    def on_motors(
        self, at: Site, memory: Any, ahead: Measurement, state: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        return moved(at, memory, ahead, state, self.on(at, theta), self._encoder(at, theta))

    def _encoder(self, at: Site, theta: jax.Array) -> jax.Array:
        encoder = self.encoder(at, theta)
        return jnp.zeros(len(at)) if encoder is None else encoder

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        encoder = self.encoder(at, theta)
        if encoder is None:
            return memory, measurement
        return memory, shown(at, memory, measurement, self.on(at, theta), encoder)

    def transmits(self, at: Site, theta: jax.Array) -> jax.Array:
        return at.scatter(jnp.where(self.on(at, theta), 1.0, 0.0)) > 0

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo needs a body and a joint more for the motor, which changes qpos and qvel; use effects.yaml"
