"""What Isaac Gym's two aircraft share: what they observe of their flight, and how hovering at a point is paid."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.frames import rotation, xyzw
from bayessim_mjx.mirrors import Mirror
from bayessim_mjx.tasks._terms import told

NAMES = (
    *(f"to_target_{i}" for i in "xyz"),
    *(f"quaternion_{i}" for i in "xyzw"),
    *(f"velocity_{i}" for i in "xyz"),
    *(f"angular_velocity_{i}" for i in "xyz"),
)
TURNED = ("to_target_y", "quaternion_x", "quaternion_z", "velocity_y", "angular_velocity_x", "angular_velocity_z")
WAY = 3.0  # m, the unit of the way to the target
MAX_SPIN = 4 * np.pi  # rad/s, of the body (each of its axes): `max_angular_velocity` of the assets


def flight(target: jax.Array | np.ndarray, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """`[13]`, world axes: way to the target / 3 m, quaternion (x, y, z, w), velocity / 2 m/s, turning / pi rad/s."""
    spin = rotation(qpos[3:7]) @ qvel[3:6]  # MuJoCo's is in the body frame
    return jnp.concatenate([(target - qpos[:3]) / WAY, xyzw(qpos[3:7]), qvel[:3] / 2, spin / jnp.pi])


def hovering(
    target: jax.Array | np.ndarray, qpos: jax.Array, qvel: jax.Array, upright: float = 1.0
) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
    """(reward of a step, distance to the target in m, metrics): at most 2 + `upright`, near, level, not turning."""
    distance, turn = jnp.linalg.norm(target - qpos[:3]), rotation(qpos[3:7])
    tilt, spin = jnp.abs(1 - turn[2, 2]), turn[2] @ qvel[3:6]
    near = 1 / (1 + distance**2)
    # p + p (w / (1 + tilt^2) + 1 / (1 + spin^2))
    level, steady = upright / (1 + tilt**2), 1 / (1 + spin**2)
    parts = told({"near": near, "level": near * level, "steady": near * steady})
    return near + near * (level + steady), distance, {"distance": distance} | parts


def left_right(joints: dict[str, str], task: tuple[str, ...] = ()) -> Mirror:
    """Make the mirror y -> -y with these images of joints and of entries of the task."""
    return Mirror(joints=joints, observations={name: f"-{name}" for name in TURNED}, normal="y", task=task)
