"""What Isaac Gym's two runners share: they run along +x, to a target 1000 m away, and observe their feet's loads."""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.frames import rotation, wrap
from bayessim_mjx.physics import mjx
from bayessim_mjx.physics.warp import wrenches

TARGET = np.array([1000.0, 0.0], np.float32)  # m
LOADS = tuple(f"{kind}_{i}" for kind in ("force", "torque") for i in "xyz")  # of a foot
HEADING = ("yaw", "roll", "angle_to_target", "up_projection", "heading_projection")


def heading(qpos: jax.Array) -> jax.Array:
    """`[5]`, see HEADING: rad, cosines."""
    turn = rotation(qpos[3:7])
    yaw, roll = jnp.arctan2(turn[1, 0], turn[0, 0]), jnp.arctan2(turn[2, 1], turn[2, 2])
    to_target = TARGET - qpos[:2]
    bearing = jnp.arctan2(to_target[1], to_target[0])
    return jnp.stack([wrap(yaw), wrap(roll), wrap(bearing - yaw), *posture(qpos)])


def posture(qpos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(body z axis . world z, body x axis . horizontal unit vector to the target)."""
    turn, to_target = rotation(qpos[3:7]), TARGET - qpos[:2]
    return turn[2, 2], turn[:2, 0] @ to_target / jnp.linalg.norm(to_target)


def posture_reward(up: jax.Array, heading: jax.Array) -> jax.Array:
    """0.1 for standing upright and up to 0.5 for facing the target."""
    return 0.1 * (up > 0.93) + jnp.where(heading > 0.8, 0.5, 0.5 * heading / 0.8)


def approach(before: jax.Array, after: jax.Array) -> jax.Array:
    """How much nearer the target is, m. |a| - |b| = (a - b) . (a + b) / (|a| + |b|) keeps micrometres of 1000 m."""
    a, b = TARGET - before[:2], TARGET - after[:2]
    return (after[:2] - before[:2]) @ (a + b) / (jnp.linalg.norm(a) + jnp.linalg.norm(b))


def foot_loads(model: mjx.Model, mj_model: mujoco.MjModel, data: mjx.Data, feet: Sequence[str]) -> jax.Array:
    """`[6 feet]`: contact force (N) and torque about the foot's origin (N m) of each foot, in the foot's frame."""
    by_body = wrenches(model, data)
    bodies = np.array([mj_model.body(name).id for name in feet])
    # cfrc_ext: torque about the robot's centre of mass, then force; world axes
    torque, force = by_body[bodies, :3], by_body[bodies, 3:]
    arm = data.subtree_com[1] - data.xpos[bodies]
    wrench = jnp.stack([force, torque + jnp.cross(arm, force)], axis=1)
    return jnp.einsum("fji,fkj->fki", data.xmat[bodies], wrench).ravel()


def mirrored_loads(partner: Mapping[str, str]) -> dict[str, str]:
    """Images of the loads of these feet in a mirror of left and right, by the names of observations."""
    turned = ("force_y", "torque_x", "torque_z")
    return {f"{a}_{load}": "-" * (load in turned) + f"{b}_{load}" for a, b in partner.items() for load in LOADS}
