"""What the sensors of a site's joints show, shared by the effects on measurements."""

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.support.site import Site


def columns(at: Site, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Position and velocity of the site's joints, `[..., n, 2]`, of qpos `[..., nq]` and qvel `[..., nv]`."""
    return jnp.stack([qpos[..., at.qadr], qvel[..., at.dadr]], axis=-1)


def written(at: Site, qpos: jax.Array, qvel: jax.Array, values: jax.Array) -> dict[str, jax.Array]:
    """{"qpos", "qvel"} with the site's joints showing `values`; the inverse of `columns`."""
    return {"qpos": qpos.at[..., at.qadr].set(values[..., 0]), "qvel": qvel.at[..., at.dadr].set(values[..., 1])}
