"""Angles, rotations and quaternions of one body (for many: vmap). Quaternions are unit ones, MuJoCo's (w, x, y, z)."""

import jax
import jax.numpy as jnp


def wrap(angle: jax.Array) -> jax.Array:
    """The angle in (-pi, pi], rad."""
    return jnp.pi - jnp.mod(jnp.pi - angle, 2 * jnp.pi)


def rotation(quat: jax.Array) -> jax.Array:
    """Rotation matrix `[3, 3]` of a quaternion `[4]`: body to world."""
    w, x, y, z = quat
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def xyzw(quat: jax.Array) -> jax.Array:
    """A quaternion `[4]` in Isaac Gym's order."""
    return jnp.roll(quat, -1)
