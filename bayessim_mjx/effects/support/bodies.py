"""Bodies, the joints that move them and gravity, shared by the effects on them; and bodies of a spec by place."""

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.support.site import Site, find
from bayessim_mjx.parameters import attributes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from mujoco import mjx

    from bayessim_mjx.effects.effect import Effect


def moved(model: mujoco.MjModel) -> np.ndarray:
    """`[nbody, nv]`, 1 where the degree of freedom moves the body."""
    above = np.eye(model.nbody, dtype=np.float32)  # [b, a]: a is b or above b
    for b in range(1, model.nbody):
        above[b] += above[model.body_parentid[b]]
    return above[:, model.dof_bodyid]


def velocity(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray) -> jax.Array:
    """Velocities of the bodies' centres of mass in the world `[n, 3]`, m/s."""
    angular, linear = jnp.split(data.cvel[ids], 2, axis=1)
    return linear + jnp.cross(angular, _arm(model, data, ids))


def project(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray, force: jax.Array) -> jax.Array:
    """Generalised force `[nv]` of forces `[n, 3]` (N, world) at the bodies' centres of mass."""
    wrench = jnp.concatenate([jnp.cross(_arm(model, data, ids), force), force], axis=1)
    return jnp.sum(data.cdof * (moved(model)[ids].T @ wrench), axis=1)  # sum_b J_b^T f_b


def _arm(model: mujoco.MjModel, data: "mjx.Data", ids: np.ndarray) -> jax.Array:
    """From the point that MuJoCo's spatial vectors of the tree refer to."""
    return data.xipos[ids] - data.subtree_com[model.body_rootid[ids]]


def inertial_site(effect: "Effect", model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
    """Find the site of bodies whose inertials change.

    It refuses those whose mass matrix was compiled as diagonal, which an offset centre of mass would fill.
    """
    at = find(effect, model, timestep, substeps)
    for name, body in zip(at.names, at.ids, strict=True):
        if model.body_dofnum[body] > 1 and int(model.body_simple[body]) == 1:
            attributes.refuse_simple(model, int(body), f"{name}.{effect.name}")
    return at


def with_inertials(model: "mjx.Model", ids: np.ndarray, new: "dict[str, jax.Array]") -> "mjx.Model":
    """With inertial fields `{body_mass, ...: [n, ...]}` of bodies; for effects that are `inertial`."""
    return model.replace(**{field: getattr(model, field).at[ids].set(value) for field, value in new.items()})


def native(spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> "Iterator[tuple[Any, int, dict[str, float]]]":
    """(body of the spec, its id, its values) for every place of an effect on bodies; "all": every one that can move."""
    compiled = spec.copy().compile()
    for place, own in values.items():
        for i, body in enumerate(spec.bodies):
            everywhere = place == "all" and compiled.body_weldid[i] != 0 and compiled.body_mass[i] > 0
            if everywhere or place in (body.name, f"body{i}"):
                yield body, i, own


def tilted(gravity: jax.Array, roll: jax.Array | float, pitch: jax.Array | float) -> jax.Array:
    """Gravity `[3]` in the frame of a robot turned by roll about the world's x, then by pitch about its y (rad)."""
    x, y, z = gravity
    # g' = R^T g, R = Ry(pitch) Rx(roll)
    x, z = jnp.cos(pitch) * x - jnp.sin(pitch) * z, jnp.sin(pitch) * x + jnp.cos(pitch) * z
    y, z = jnp.cos(roll) * y + jnp.sin(roll) * z, jnp.cos(roll) * z - jnp.sin(roll) * y
    return jnp.stack([x, y, z])
