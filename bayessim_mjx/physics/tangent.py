"""Differences and steps of qpos in its tangent space: rotation vectors where there are quaternions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco


def difference(model: mujoco.MjModel, measured: jax.Array, simulated: jax.Array) -> jax.Array:
    """qpos minus qpos in the tangent space `[nv]`: rotation vectors where there are quaternions."""
    parts = []
    for j in range(model.njnt):
        q, kind = int(model.jnt_qposadr[j]), int(model.jnt_type[j])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            parts.append(measured[q : q + 3] - simulated[q : q + 3])
            q += 3
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            parts.append(_rotation(measured[q : q + 4], simulated[q : q + 4]))
        else:
            parts.append(measured[q : q + 1] - simulated[q : q + 1])
    return jnp.concatenate(parts)


def _rotation(a: jax.Array, b: jax.Array) -> jax.Array:
    """Rotation vector of conj(b) a, small-angle safe (2 Im, exact to third order at the errors of a window)."""
    w = a[0] * b[0] + jnp.dot(a[1:], b[1:])
    v = b[0] * a[1:] - a[0] * b[1:] - jnp.cross(b[1:], a[1:])
    return 2.0 * v * jnp.sign(w)


def integrate(model: mujoco.MjModel, qpos: jax.Array, step: jax.Array) -> jax.Array:
    """qpos moved by `step` `[nv]` in the tangent space."""
    out = qpos
    for j in range(model.njnt):
        q, v, kind = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), int(model.jnt_type[j])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            out = out.at[q : q + 3].add(step[v : v + 3])
            q, v = q + 3, v + 3
        if kind in (int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)):
            out = out.at[q : q + 4].set(_turned(qpos[q : q + 4], step[v : v + 3]))
        else:
            out = out.at[q].add(step[v])
    return out


def _turned(quat: jax.Array, by: jax.Array) -> jax.Array:
    r = jnp.concatenate([jnp.sqrt(jnp.maximum(0.0, 1.0 - jnp.sum(by * by) / 4))[None], by / 2])
    w = quat[0] * r[0] - jnp.dot(quat[1:], r[1:])
    v = quat[0] * r[1:] + r[0] * quat[1:] + jnp.cross(quat[1:], r[1:])
    new = jnp.concatenate([w[None], v])
    return new / jnp.linalg.norm(new)
