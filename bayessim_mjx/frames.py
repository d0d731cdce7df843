"""Angles, rotations and quaternions of one body (for many: vmap). Quaternions are unit ones, MuJoCo's (w, x, y, z)."""

import jax
import jax.numpy as jnp


def wrap(angle: jax.Array) -> jax.Array:
    """Wrap the angle to (-pi, pi], rad."""
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


def product(one: jax.Array, two: jax.Array) -> jax.Array:
    """Multiply quaternions `[4]`: the rotation `two` followed by `one`."""
    w, v, x, u = one[0], one[1:], two[0], two[1:]
    return jnp.concatenate([jnp.array([w * x - v @ u]), w * u + x * v + jnp.cross(v, u)])


def conjugate(quat: jax.Array) -> jax.Array:
    """Invert a rotation given as a quaternion `[4]`."""
    return quat * jnp.array([1.0, -1.0, -1.0, -1.0])


def xyzw(quat: jax.Array) -> jax.Array:
    """Reorder a quaternion `[4]` as Isaac Gym has it."""
    return jnp.roll(quat, -1)
