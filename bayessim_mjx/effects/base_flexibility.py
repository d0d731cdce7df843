"""Base flexibility: the robot's base rocks on its mount (a table, a tripod, a cabinet, rubber feet, a soft flange)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import moved, tilted
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site, find, joint_dofs, staggered
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError

STOP = 0.3  # rad: a base that topples leans against something
SETTLING = 3  # rounds of finding how the robot's weight tilts the base at the start


@dataclasses.dataclass(frozen=True)
class BaseFlexibility(Effect):
    """I p'' = (moment of the robot on its base) - k p - d p', I = k / (2 pi f)^2, d = 2 zeta sqrt(k I).

    p: tilt of the base about the world's x and y axes, small. They run `depth` below the origin of the robot's first
    body: a table rocks about its feet and carries the robot to and fro. Robot and base are solved together: gravity
    tilts in the robot's frame, p' and p'' act on all bodies. Left out: what constraints (contacts, joint limits) do to
    the base. At the start the base has settled under the robot's weight. Robots with a fixed base only. Of several
    trees of bodies the robot is the one of the first actuator at a joint (without one, the first that moves); the
    others stand beside the mount. Two arms on one table are one tree where one body carries both.

    Parameters: `compliance` 1/k, rad/(N m), neutral 0; `frequency` f, Hz, of the base without the robot; `damping`
    zeta, likewise; `depth`, m; the latter three without effect where the compliance is 0.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "base_flexibility"
    kind: ClassVar[str] = "world"
    noun: ClassVar[str] = "flexible mount"
    follows: ClassVar[bool] = True
    lacks: ClassVar[str] = "a flexible mount"
    separates: ClassVar[str] = "one joint moved and the resting ones (or an IMU on the base) watched; the base clamped"
    witness: ClassVar[tuple[str, str] | None] = ("imu", "an IMU on the base (`imu:...`)")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "compliance", 0.0, 0.0, 0.01, unit="rad/(N m)", per="1/moment", reach=(0.0, 0.6), grid=(0.003, 0.03, 0.3)
        ),
        Quantity("frequency", 10.0, 2.0, 30.0, unit="Hz", grid=(0.1, 0.5), shape=True),
        Quantity("damping", 0.1, 0.01, 1.0, grid=(0.1,), shape=True),
        Quantity("depth", 0.0, 0.0, 1.0, unit="m", grid=(0.0, 0.2), shape=True),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """Bind the site; refuse robots that nothing holds."""
        free = np.flatnonzero(mj_model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
        if len(free) or not mj_model.nv:
            why = f"joint {mj_model.joint(free[0]).name!r} is free" if len(free) else "the model has no joints"
            raise UserError(f"{self.name}: {why}; allowed: robots whose base is fixed to the world")
        return find(self, mj_model, timestep, substeps)

    def init(self, at: Site) -> Any:
        yes, no = jnp.ones((), bool), jnp.zeros((), bool)
        none = jnp.zeros(2)
        return {"tilt": none, "rate": none, "acceleration": none, "fresh": yes, "moving": no}

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        # how it rocks amid a recording is not known: as it is pushed just then; before the recording it rests
        moving = jnp.ones((), bool) if motion.time is None else motion.time > 0
        return memory | {"moving": moving}, motion

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        compliance, frequency, ratio, depth = at.values(theta)[0]
        slow, dt = 1.0 / (2 * jnp.pi * frequency), step.dt
        rate, lag = memory["rate"], 2 * ratio * slow
        robot = _robot(at, step, rate, depth)
        settled = _settled(robot, compliance, step.force, memory["moving"])
        tilt = jnp.where(memory["fresh"], settled, memory["tilt"])
        carried, moment = robot.pushed(tilt, step.force)
        # a resolved spring is looked at where the sub-step begins, which costs no energy; a stiff one where it ends
        late = lag + dt * jnp.maximum(1.0 - (slow / dt) ** 2, 0.0)
        if not staggered(at.mj_model):  # RK4 moves the base; it is stable where its stages resolve the base alone
            late, slow, dt = lag, jnp.maximum(slow, dt), 0.0
        # Schur complement of the robot; all times 1/k
        matrix = compliance * (robot.inertia - robot.shed @ robot.coupling.T) + (slow**2 + dt * late) * jnp.eye(2)
        acceleration = _solve(matrix, compliance * moment - tilt - late * rate)
        new = jnp.clip(tilt + dt * (rate + dt * acceleration), -STOP, STOP)
        rate = jnp.where(jnp.abs(new) < STOP, rate + dt * acceleration, 0.0)
        no = jnp.zeros((), bool)
        left = {"tilt": new, "rate": rate, "acceleration": acceleration, "fresh": no, "moving": no}
        return left, jnp.where(compliance > 0, carried - robot.coupling.T @ acceleration, 0.0)

    def rates(self, at: Site, memory: Any) -> dict[str, jax.Array]:
        return {"tilt": memory["rate"], "rate": memory["acceleration"]}

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo needs two joints more under the robot, which changes qpos and qvel; use effects.yaml"


@dataclasses.dataclass(frozen=True)
class _Robot:
    """What the base feels of the robot, moments about the base's origin.

    momentum: `[nv, 6]` (angular, linear) per unit of each joint's speed, world axes; coupling: `[2, nv]`, its moments
    about x and y; inertia `[2, 2]`; shed `[2, nv]`, coupling times the inverse of the mass matrix; bias `[2]`, moment
    of the inertial forces at no acceleration; coriolis `[nv]`, what the base's rate does to the joints; lever `[3]`,
    mass times centre of mass from the base; gravity `[3]`.
    """

    momentum: jax.Array
    coupling: jax.Array
    inertia: jax.Array
    shed: jax.Array
    bias: jax.Array
    coriolis: jax.Array
    lever: jax.Array
    gravity: jax.Array

    def moment(self, tilt: jax.Array) -> jax.Array:
        """Of gravity, `[2]`."""
        return jnp.cross(self.lever, tilted(self.gravity, *tilt))[:2]

    def pushed(self, tilt: jax.Array, force: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Force on the joints `[nv]` of a tilted base, and the moment `[2]` on it where it does not accelerate."""
        gravity = tilted(self.gravity, *tilt) - self.gravity
        carried = self.momentum[:, 3:] @ gravity + self.coriolis
        return carried, self.moment(tilt) - self.bias - self.shed @ (force + carried)


def _robot(at: Site, step: SubStep, rate: jax.Array, depth: jax.Array) -> _Robot:
    model, data = at.mj_model, step.data
    root, trees = _root(model), np.asarray(model.body_rootid)
    bodies, carried = np.flatnonzero(trees == root), trees[model.dof_bodyid] == root
    base = jnp.asarray(model.body_pos[root], jnp.float32) - depth * jnp.array([0.0, 0.0, 1.0])
    # MuJoCo's spatial vectors (angular, linear) refer to the centre of mass of their tree
    momentum = jnp.where(carried[:, None], _times(data._impl.crb[model.dof_bodyid], data.cdof), 0.0)
    arm, axes = data.subtree_com[root] - base, jnp.eye(3)[:2]
    rocking = jnp.concatenate([axes, jnp.cross(axes, arm[None])], axis=-1)  # [2, 6]
    # forces on the bodies at no acceleration of joints and base: I a + v x I v, and what the base's velocity u adds
    inertia, speed = data._impl.cinert[bodies], data.cvel[bodies]
    below = moved(model)[bodies]
    still = _times(inertia, below @ (data.cdof_dot * data.qvel[:, None])) + _across(speed, _times(inertia, speed))
    sway = jnp.broadcast_to(rate @ rocking, speed.shape)
    extra = _times(inertia, _turned(sway, speed)) + _across(sway, _times(inertia, speed))
    extra = extra + _across(speed + sway, _times(inertia, sway))
    coupling = _moments(momentum, arm).T
    disabled = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return _Robot(
        momentum=momentum,
        coupling=coupling,
        inertia=rocking @ _times(data._impl.crb[root], rocking).T,
        shed=coupling @ step.inverse,
        bias=jnp.sum(_moments(still + extra, arm), axis=0),
        coriolis=-jnp.sum(data.cdof * (below.T @ extra), axis=1),
        lever=step.model.body_mass[bodies] @ (data.xipos[bodies] - base),
        gravity=jnp.zeros(3) if disabled else step.model.opt.gravity,
    )


def _root(model: mujoco.MjModel) -> int:
    """Find the body of the robot that the world carries."""
    driven = joint_dofs(model)
    first = driven[driven >= 0][0] if (driven >= 0).any() else 0
    return int(model.body_rootid[model.dof_bodyid[first]])


def _times(inertia: jax.Array, motion: jax.Array) -> jax.Array:
    """Spatial inertia `[..., 10]` (matrix, mass times position, mass) times motion `[..., 6]` -> force."""
    matrix, place, mass = inertia[..., np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])], inertia[..., 6:9], inertia[..., 9:]
    angular, linear = motion[..., :3], motion[..., 3:]
    turning = jnp.sum(matrix * angular[..., None, :], axis=-1) + jnp.cross(place, linear)
    return jnp.concatenate([turning, mass * linear - jnp.cross(place, angular)], axis=-1)


def _across(motion: jax.Array, force: jax.Array) -> jax.Array:
    """motion x force, `[n, 6]` each."""
    (angular, linear), (turning, pushing) = jnp.split(motion, 2, axis=-1), jnp.split(force, 2, axis=-1)
    moment = jnp.cross(angular, turning) + jnp.cross(linear, pushing)
    return jnp.concatenate([moment, jnp.cross(angular, pushing)], axis=-1)


def _turned(motion: jax.Array, other: jax.Array) -> jax.Array:
    """motion x other motion, `[n, 6]` each."""
    (angular, linear), (turning, moving) = jnp.split(motion, 2, axis=-1), jnp.split(other, 2, axis=-1)
    return jnp.concatenate([jnp.cross(angular, turning), jnp.cross(angular, moving) + jnp.cross(linear, turning)], -1)


def _moments(force: jax.Array, arm: jax.Array) -> jax.Array:
    """Moments `[n, 2]` about x and y at the base of spatial forces `[n, 6]` that refer to `arm` `[3]` from it."""
    return (force[:, :3] + jnp.cross(arm, force[:, 3:]))[:, :2]


def _settled(robot: _Robot, compliance: jax.Array, force: jax.Array, moving: jax.Array) -> jax.Array:
    """Tilt `[2]` at which the mount carries the robot, at rest or `moving` under this force: p = moment(p) / k."""
    tilt = jnp.zeros(2)
    for _ in range(SETTLING):
        moment = jnp.where(moving, robot.pushed(tilt, force)[1], robot.moment(tilt))
        tilt = jnp.clip(compliance * moment, -STOP, STOP)
    return tilt


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    (a, b), (_, d) = matrix
    return jnp.stack([d * right[0] - b * right[1], a * right[1] - b * right[0]]) / (a * d - b * b)
