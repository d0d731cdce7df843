"""Base flexibility: the robot's base rocks on its mount (a table, a tripod, a cabinet, rubber feet, a soft flange)."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.bodies import moved
from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.gravity_tilt import tilted
from bayessim_mjx.effects.site import Site, SubStep, find
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from mujoco import mjx

STOP = 0.3  # rad: a base that topples leans against something
SETTLING = 3  # rounds of finding how the robot's weight tilts the base at the start


@dataclasses.dataclass(frozen=True)
class BaseFlexibility(Effect):
    """I p'' = (moment of the robot on its base) - k p - d p', I = k / (2 pi f)^2, d = 2 zeta sqrt(k I).

    p: tilt of the base about the world's x and y axes through the origin of the robot's first body, small. Robot and
    base are solved together: gravity tilts in the robot's frame and p'' moves all bodies. Left out: Coriolis forces of
    p', and constraint forces (contacts, joint limits) on the base. At the start the base has settled under the robot's
    weight. Robots with a fixed base only.

    Parameters: `compliance` 1/k, rad/(N m), neutral 0; `frequency` f, Hz, of the base without the robot; `damping`
    zeta, likewise; the latter two without effect where the compliance is 0.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "base_flexibility"
    kind: ClassVar[str] = "world"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("compliance", 0.0, 0.0, 0.01, unit="rad/(N m)", grid=(0.003, 0.03, 0.3)),
        Quantity("frequency", 10.0, 2.0, 30.0, unit="Hz", grid=(0.1, 0.5), shape=True),
        Quantity("damping", 0.1, 0.01, 0.5, grid=(0.1,), shape=True),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """The site; refuses robots that nothing holds."""
        free = np.flatnonzero(mj_model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
        if len(free) or not mj_model.nv:
            why = f"joint {mj_model.joint(free[0]).name!r} is free" if len(free) else "the model has no joints"
            raise UserError(f"{self.name}: {why}; allowed: robots whose base is fixed to the world")
        return find(self, mj_model, timestep, substeps)

    def init(self, at: Site) -> Any:
        return {"tilt": jnp.zeros(2), "rate": jnp.zeros(2), "fresh": jnp.ones((), bool)}

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        compliance, frequency, ratio = at.values(theta)[0]
        slow, dt = 1.0 / (2 * jnp.pi * frequency), step.dt
        robot = _robot(at, step)
        tilt = jnp.where(memory["fresh"], _settled(robot, compliance), memory["tilt"])
        rate, lag = memory["rate"], 2 * ratio * slow
        gravity = tilted(robot.gravity, *tilt) - robot.gravity
        free = robot.shed @ (step.force + robot.momentum[:, 3:] @ gravity)
        moment = robot.moment(tilt) - robot.bias - free
        # Schur complement of the robot; k p and d p' at the end of the sub-step; all times 1/k
        matrix = compliance * (robot.inertia - robot.shed @ robot.coupling.T) + (slow**2 + dt * (lag + dt)) * jnp.eye(2)
        acceleration = _solve(matrix, compliance * moment - tilt - (dt + lag) * rate)
        new = jnp.clip(tilt + dt * (rate + dt * acceleration), -STOP, STOP)
        left = {"tilt": new, "rate": (new - tilt) / dt, "fresh": jnp.zeros((), bool)}
        force = robot.momentum[:, 3:] @ gravity - robot.coupling.T @ acceleration
        return left, jnp.where(compliance > 0, force, 0.0)

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo needs two joints more under the robot, which changes qpos and qvel; use effects.yaml"


@dataclasses.dataclass(frozen=True)
class _Robot:
    """What the base feels of the robot, moments about the base's origin.

    momentum: `[nv, 6]` (angular, linear) per unit of each joint's speed, world axes; coupling: `[2, nv]`, its moments
    about x and y; inertia `[2, 2]`; shed `[2, nv]`, coupling times the inverse of the mass matrix; bias `[2]`, moment of
    the inertial forces at no acceleration; lever `[3]`, mass times centre of mass from the base; gravity `[3]`.
    """

    momentum: jax.Array
    coupling: jax.Array
    inertia: jax.Array
    shed: jax.Array
    bias: jax.Array
    lever: jax.Array
    gravity: jax.Array

    def moment(self, tilt: jax.Array) -> jax.Array:
        """Of gravity, `[2]`."""
        return jnp.cross(self.lever, tilted(self.gravity, *tilt))[:2]


def _robot(at: Site, step: SubStep) -> _Robot:
    from mujoco.mjx._src.math import inert_mul, motion_cross_force

    model, data = at.mj_model, step.data
    root = model.body_rootid[model.dof_bodyid]
    roots = np.unique(root)
    times = jax.vmap(inert_mul)
    momentum = times(data._impl.crb[model.dof_bodyid], data.cdof)
    base = jnp.asarray(model.body_pos[roots[0]], jnp.float32)
    arm = data.subtree_com[root] - base  # from the base to where MuJoCo's spatial vectors refer to
    coupling = (momentum[:, :3] + jnp.cross(arm, momentum[:, 3:]))[:, :2].T
    motion = _rocking(data.subtree_com[roots] - base)  # [trees, 2, 6]
    inertia = sum(
        motion[i] @ jax.vmap(inert_mul, (None, 0))(data._impl.crb[r], motion[i]).T for i, r in enumerate(roots)
    )
    # forces on the bodies at no acceleration of the joints: I a + v x I v
    below = np.flatnonzero(np.isin(model.body_rootid, roots))
    acceleration = moved(model)[below] @ (data.cdof_dot * data.qvel[:, None])
    inert = data._impl.cinert[below]
    force = times(inert, acceleration) + jax.vmap(motion_cross_force)(data.cvel[below], times(inert, data.cvel[below]))
    away = data.subtree_com[model.body_rootid[below]] - base
    weighed = step.model.body_mass[below][:, None] * (data.xipos[below] - base)
    disabled = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return _Robot(
        momentum=momentum,
        coupling=coupling,
        inertia=inertia,
        shed=coupling @ step.inverse,
        bias=jnp.sum(force[:, :3] + jnp.cross(away, force[:, 3:]), axis=0)[:2],
        lever=jnp.sum(weighed, axis=0),
        gravity=jnp.zeros(3) if disabled else step.model.opt.gravity,
    )


def _rocking(arm: jax.Array) -> jax.Array:
    """Motions `[trees, 2, 6]` of points at `arm` `[trees, 3]` from the base that rocks about x and about y."""
    axes = jnp.broadcast_to(jnp.eye(3)[:2], (len(arm), 2, 3))
    return jnp.concatenate([axes, jnp.cross(axes, arm[:, None])], axis=-1)


def _settled(robot: _Robot, compliance: jax.Array) -> jax.Array:
    """Tilt `[2]` at which the mount carries the robot at rest: p = moment(p) / k."""
    tilt = jnp.zeros(2)
    for _ in range(SETTLING):
        tilt = jnp.clip(compliance * robot.moment(tilt), -STOP, STOP)
    return tilt


def _solve(matrix: jax.Array, right: jax.Array) -> jax.Array:
    (a, b), (_, d) = matrix
    return jnp.stack([d * right[0] - b * right[1], a * right[1] - b * right[0]]) / (a * d - b * b)
