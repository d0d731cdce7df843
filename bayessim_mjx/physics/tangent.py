"""Differences and steps of qpos in its tangent space: rotation vectors where there are quaternions."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

SMALL = 1e-6  # squared tangent, below which series are exact in single precision


def difference(model: mujoco.MjModel, measured: jax.Array, simulated: jax.Array) -> jax.Array:
    """qpos minus qpos in the tangent space `[nv]`: rotation vectors where there are quaternions."""
    return jnp.concatenate(
        [_rotation(measured[q], simulated[q]) if turns else measured[q] - simulated[q] for q, _, turns in _parts(model)]
    )


def addresses(model: mujoco.MjModel) -> list[int | None]:
    """For each degree of freedom its place in qpos; None for a rotation's."""
    return [at for q, _, turns in _parts(model) for at in ([None] * 3 if turns else range(q.start, q.stop))]


def in_tangent(model: mujoco.MjModel, sd: np.ndarray) -> np.ndarray:
    """Errors of qpos [nq] as errors of its tangent [nv]: a rotation is twice its quaternion's imaginary part."""
    return np.concatenate([2 * sd[q][1:] if turns else sd[q] for q, _, turns in _parts(model)])


def _parts(model: mujoco.MjModel) -> Iterator[tuple[slice, slice, bool]]:
    """(place in qpos, place in qvel, is it a rotation) of every joint; a free joint has two parts."""
    for j in range(model.njnt):
        q, v, kind = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), int(model.jnt_type[j])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            yield slice(q, q + 3), slice(v, v + 3), False
            q, v = q + 3, v + 3
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            yield slice(q, q + 4), slice(v, v + 3), True
        else:
            yield slice(q, q + 1), slice(v, v + 1), False


def _rotation(a: jax.Array, b: jax.Array) -> jax.Array:
    """Rotation vector of conj(b) a, the shorter way round: the logarithm of a quaternion, 2 v / |v| atan2(|v|, w)."""
    w = a[0] * b[0] + jnp.dot(a[1:], b[1:])
    v = b[0] * a[1:] - a[0] * b[1:] - jnp.cross(b[1:], a[1:])
    v, w = jnp.where(w < 0, -v, v), jnp.abs(w)
    square = jnp.dot(v, v)
    small = square < SMALL * w * w
    size = jnp.sqrt(jnp.where(small, 1.0, square))  # where it is 0, neither value nor derivative exists
    near = 1.0 / jnp.where(small, w, 1.0)
    return 2.0 * v * jnp.where(small, near * (1.0 - square * near * near / 3.0), jnp.arctan2(size, w) / size)


def integrate(model: mujoco.MjModel, qpos: jax.Array, step: jax.Array) -> jax.Array:
    """qpos moved by `step` `[nv]` in the tangent space."""
    out = qpos
    for q, v, turns in _parts(model):
        out = out.at[q].set(_turned(qpos[q], step[v])) if turns else out.at[q].add(step[v])
    return out


def noisy(model: mujoco.MjModel, key: jax.Array, qpos: jax.Array, sd: jax.Array | np.ndarray | float) -> jax.Array:
    """qpos [..., nq] with Gaussian noise of standard deviations sd ([nv], or one) in the tangent: unit quaternions."""
    steps = sd * jax.random.normal(key, (*qpos.shape[:-1], model.nv))
    rows = jax.vmap(lambda q, by: integrate(model, q, by))(qpos.reshape(-1, model.nq), steps.reshape(-1, model.nv))
    return rows.reshape(qpos.shape)


def _turned(quat: jax.Array, by: jax.Array) -> jax.Array:
    square = jnp.dot(by, by) / 4
    small = square < SMALL
    half = jnp.sqrt(jnp.where(small, 1.0, square))
    share = jnp.where(small, 1.0 - square / 6, jnp.sin(half) / half)
    r = jnp.concatenate([jnp.where(small, 1.0 - square / 2, jnp.cos(half))[None], share * by / 2])
    w = quat[0] * r[0] - jnp.dot(quat[1:], r[1:])
    v = quat[0] * r[1:] + r[0] * quat[1:] + jnp.cross(quat[1:], r[1:])
    new = jnp.concatenate([w[None], v])
    return new / jnp.linalg.norm(new)
