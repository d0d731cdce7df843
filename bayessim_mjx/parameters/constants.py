"""What MuJoCo derives at compile time, recomputed in JAX: inverse weights, inertias at qpos0, lengths, statistics.

The equations are those of `mj_setConst` (MuJoCo, engine_setconst.c), at qpos0.
"""

import functools
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.compat import mjx
from bayessim_mjx.linalg import inverse_lower
from bayessim_mjx.parameters import geometry

_MASS = {"body_mass"}
_SHAPE = {"geom_size", "geom_rbound"}
_POSE = {"qpos0", "body_pos", "body_quat", "body_ipos", "jnt_pos", "jnt_axis", "geom_pos", "geom_quat", "site_pos"}
_POSE |= {"site_quat", "eq_data"}
_INERTIA = _MASS | {"body_inertia", "body_iquat", "dof_armature", "tendon_armature", "actuator_gear"}
_PRIMARY = _SHAPE | _POSE | _INERTIA  # from which others are derived
_PLANE, _HFIELD = int(mujoco.mjtGeom.mjGEOM_PLANE), int(mujoco.mjtGeom.mjGEOM_HFIELD)


def set_const(model: mjx.Model) -> mjx.Model:
    """Recompute the derived constants of `model` from its primary fields. Pure JAX, for use under `vmap`.

    Returns:
        The model with body_subtreemass, body_invweight0, dof_invweight0, dof_M0, tendon_length0, tendon_invweight0,
        actuator_acc0, the anchor of connect constraints in the second body, cam_pos0, cam_poscom0 and stat.* brought
        up to date. Not covered, because `mjx.Model` does not hold what is needed: the lights' rest poses (rendering),
        numbers that the compiler froze from ratios (`dampratio`, automatic `springlength`, automatic weld poses).
    """
    return model.tree_replace(derived(model))


def renewed(nominal: mjx.Model, leaves: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Renew what a timestep reads of what MuJoCo derives from these leaves, by dotted name.

    Where none of them differs from the nominal model's the compiler's own numbers stay, not their recomputation in
    float32. What only cameras are placed by is left out.
    """
    primary = {name: leaf for name, leaf in leaves.items() if name in _PRIMARY}
    return _renewed(nominal, leaves, tuple(sorted(primary))) if primary else {}


@functools.partial(jax.jit, static_argnums=2)  # compiled once also when called op by op
def _renewed(nominal: mjx.Model, leaves: dict[str, jax.Array], primary: tuple[str, ...]) -> dict[str, jax.Array]:
    present = functools.reduce(jnp.logical_or, (jnp.any(leaves[name] != _leaf(nominal, name)) for name in primary))
    new = derived(nominal.tree_replace(leaves), primary, reference=nominal, pictures=False)
    return {name: jnp.where(present, leaf, _leaf(nominal, name)) for name, leaf in new.items()}


def _leaf(model: mjx.Model, name: str) -> Any:
    return functools.reduce(getattr, name.split("."), model)


def derived(
    model: mjx.Model,
    changed: Collection[str] | None = None,
    reference: mjx.Model | None = None,
    pictures: bool = True,
) -> dict[str, jax.Array]:
    """Compute derived leaves by dotted name.

    Args:
        model: a model (JAX implementation) whose primary fields were changed.
        changed: names of the changed leaves; only what depends on them is computed. None: everything.
        reference: the model as compiled. A statistic that its MJCF overrides (`<statistic extent=...>`) keeps its
            number: recognised because the reference's own fields do not give it.
        pictures: whether sizes that no timestep reads (stat.center, extent, meansize) are computed as well.
    """
    names = None if changed is None else set(changed)
    pose = names is None or bool(names & _POSE)
    inertia = pose or bool((names or set()) & _INERTIA)
    new: dict[str, jax.Array] = {}
    if not (inertia or (names or set()) & _SHAPE):
        return new
    with jax.default_matmul_precision("highest"):
        data = _at_rest(model)
        if names is None or names & _MASS:
            new["body_subtreemass"] = jnp.asarray(_descendants(model)) @ model.body_mass
        if model.ncam and (names is None or names & (_MASS | _POSE)):
            new.update(_cameras(model, data))
        if inertia and model.nv:
            new.update(_inertias(model, data))
        if pose:
            new.update(_lengths(model, data))
        sized = pictures and (pose or bool((names or set()) & _SHAPE))
        new.update(_statistics(model, data, reference, new, sized, names is None or bool(names & _MASS)))
    return new


def _at_rest(model: mjx.Model) -> mjx.Data:
    data = mjx.make_data(model).replace(qpos=model.qpos0)
    return mjx.tendon(model, mjx.com_pos(model, mjx.kinematics(model, data)))


def _descendants(model: mjx.Model) -> np.ndarray:
    """[i, j] = 1 if body j is body i or hangs below it."""
    below = np.eye(model.nbody, dtype=np.float32)
    for j in range(model.nbody - 1, 0, -1):
        below[model.body_parentid[j]] += below[j]
    return below


def _inertias(model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    """Everything that comes from the mass matrix M(qpos0) = L L'."""
    data = mjx.crb(model, data)
    crb_diagonal = jnp.diagonal(mjx.full_m(model, data))
    data = mjx.transmission(model, mjx.tendon_armature(model, data))
    mass_matrix = mjx.full_m(model, data)
    # inv(L) once and products with it: many times cheaper under vmap than a solve per Jacobian, and as accurate here
    inverse = inverse_lower(jnp.linalg.cholesky(mass_matrix))
    moving = np.flatnonzero(model.body_dofnum[model.body_weldid] > 0)
    jacobians = _body_jacobians(model, data, moving).reshape(-1, model.nv)

    def weights(rows: jax.Array) -> jax.Array:  # J inv(M) J' = |inv(L) J'|^2, its diagonal
        return jnp.sum((rows @ inverse.T) ** 2, axis=1)

    new = {
        "dof_M0": crb_diagonal,
        "stat.meaninertia": jnp.mean(jnp.diagonal(mass_matrix)),
        "dof_invweight0": _dof_weights(model, weights(jnp.eye(model.nv))),
        "body_invweight0": _body_weights(model, moving, weights(jacobians)),
    }
    if model.ntendon:
        new["tendon_invweight0"] = weights(_impl(data, "ten_J"))
    if model.nu:  # acc0 = |inv(M) moment'|
        new["actuator_acc0"] = jnp.linalg.norm(_impl(data, "actuator_moment") @ inverse.T @ inverse, axis=1)
    return new


def _body_jacobians(model: mjx.Model, data: mjx.Data, bodies: np.ndarray) -> jax.Array:
    """Jacobians of the bodies' centres of mass, translation above rotation, `[n, 6, nv]`."""
    moves = _descendants(model)[model.dof_bodyid][:, bodies].T  # [n, nv]: does the dof move the body?
    angular, linear = jnp.split(_impl(data, "cdof"), 2, axis=1)
    arm = data.xipos[bodies] - _impl(data, "subtree_com")[model.body_rootid[bodies]]
    translation = linear[None] + jnp.cross(angular[None], arm[:, None])
    both = jnp.concatenate([translation, jnp.broadcast_to(angular[None], translation.shape)], axis=-1)
    return jnp.swapaxes(both * moves[..., None], 1, 2)


def _dof_weights(model: mjx.Model, squares: jax.Array) -> jax.Array:
    """Diagonal of inv(M), averaged over the translations and the rotations of free and ball joints."""
    average = np.eye(model.nv, dtype=np.float32)
    for kind, start in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        for block in {0: (0, 3), 1: (0,)}.get(int(kind), ()):
            average[start + block : start + block + 3, start + block : start + block + 3] = 1 / 3
    weights = jnp.asarray(average) @ squares
    sliders = np.flatnonzero(model.body_simple[model.dof_bodyid] == 2)
    return weights.at[sliders].set(1 / model.body_mass[model.dof_bodyid[sliders]])


def _body_weights(model: mjx.Model, moving: np.ndarray, squares: jax.Array) -> jax.Array:
    """Mean translational and rotational inverse weight of each body, `[nbody, 2]`; 0 for static bodies."""
    weights = jnp.zeros((model.nbody, 2)).at[moving].set(squares.reshape(-1, 2, 3).mean(-1))
    sliders = np.flatnonzero(model.body_simple == 2)
    sliders = sliders[np.isin(sliders, moving)]
    exact = jnp.stack([1 / model.body_mass[sliders], jnp.zeros(len(sliders))], axis=-1)
    return weights.at[sliders].set(exact)


def _lengths(model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    new = {"tendon_length0": data.ten_length} if model.ntendon else {}
    connect = (model.eq_type == int(mujoco.mjtEq.mjEQ_CONNECT)) & (model.eq_objtype == int(mujoco.mjtObj.mjOBJ_BODY))
    (ids,) = np.nonzero(connect)
    if len(ids):
        one, two = model.eq_obj1id[ids], model.eq_obj2id[ids]
        anchor = data.xpos[one] + jnp.einsum("nij,nj->ni", data.xmat[one], model.eq_data[ids, :3])
        local = jnp.einsum("nji,nj->ni", data.xmat[two], anchor - data.xpos[two])
        new["eq_data"] = model.eq_data.at[ids, 3:6].set(local)
    return new


def _cameras(model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    body, target = model.cam_bodyid, model.cam_targetbodyid
    offset = jnp.einsum("nij,nj->ni", data.xmat[body], model.cam_pos)
    centre = _impl(data, "subtree_com")[np.where(target >= 0, target, body)]
    return {"cam_pos0": offset, "cam_poscom0": offset + data.xpos[body] - centre}


def _statistics(
    model: mjx.Model,
    data: mjx.Data,
    reference: mjx.Model | None,
    new: dict[str, jax.Array],
    sized: bool,
    heavier: bool,
) -> dict[str, jax.Array]:
    """stat.*: what changed (sizes, masses), unless the MJCF overrides it."""
    found: dict[str, jax.Array] = {}
    if model.nbody > 1 and heavier:
        found["stat.meanmass"] = jnp.mean(model.body_mass[1:])
    if sized:
        found.update(_sizes(model, data))
    if "stat.meaninertia" in new:
        found["stat.meaninertia"] = new["stat.meaninertia"]
    if reference is None:
        return found
    own = {"stat.meanmass": jnp.mean(reference.body_mass[1:])} if "stat.meanmass" in found else {}
    if "stat.extent" in found:
        own.update(_sizes(reference, _at_rest(reference)))
    if "stat.meaninertia" in found:  # armature of tendons is in M, but not in dof_M0
        own["stat.meaninertia"] = found["stat.meaninertia"] + jnp.mean(reference.dof_M0 - new["dof_M0"])
    return {k: _unless_overridden(getattr(reference.stat, k[5:]), own[k], v) for k, v in found.items()}


def _unless_overridden(compiled: jax.Array, own: jax.Array, new: jax.Array) -> jax.Array:
    derived = jnp.all(jnp.abs(compiled - own) <= 1e-4 * jnp.maximum(jnp.abs(own), jnp.max(jnp.abs(own)) * 1e-2) + 1e-7)
    return jnp.where(derived, new, compiled)


def _sizes(model: mjx.Model, data: mjx.Data) -> dict[str, jax.Array]:
    """Bounding box at qpos0 and mean body size (mj_setConst, setStat)."""
    radius = model.geom_rbound
    plane = model.geom_type == _PLANE
    wide = jnp.max(model.geom_size[:, :2], axis=1)
    radius = jnp.where(plane & (radius <= 0), jnp.where(wide > 0, 0.1 * wide, 0.01), radius)
    for g in np.flatnonzero(model.geom_type == _HFIELD):
        radius = radius.at[g].set(
            jnp.where(radius[g] > 0, radius[g], 0.1 * np.max(model.hfield_size[model.geom_dataid[g]]))
        )
    points = [data.xpos[1:], data.xipos[1:], data.xanchor, data.site_xpos]
    low = jnp.min(jnp.concatenate([*points, data.geom_xpos - radius[:, None]]), axis=0)
    high = jnp.max(jnp.concatenate([*points, data.geom_xpos + radius[:, None]]), axis=0)
    found = {"stat.center": (low + high) / 2}
    size = jnp.zeros(model.nbody)
    for j, body in enumerate(model.jnt_bodyid):
        for b in (int(body), int(model.body_parentid[body])):
            size = size.at[b].max(jnp.linalg.norm(data.xipos[b] - data.xanchor[j]))
    size = size.at[0].set(0.0)
    reach = model.geom_rbound + jnp.linalg.norm(data.xipos[model.geom_bodyid] - data.geom_xpos, axis=1)
    size = size.at[model.geom_bodyid].max(jnp.where(model.geom_rbound > 0, reach, 0.0))
    mean = jnp.mean(jnp.maximum(size[1:], 1e-5)) if model.nbody > 1 else model.stat.meansize
    extent = jnp.maximum(1e-5, jnp.max(high - low))
    return found | {"stat.meansize": mean, "stat.extent": jnp.maximum(extent, 2 * mean)}


def bounds(model: mjx.Model, size: jax.Array, geoms: Collection[int]) -> dict[str, jax.Array]:
    """geom_rbound and geom_aabb with those of the given primitives recomputed from `size` `[ngeom, 3]`."""
    radius, box = model.geom_rbound, model.geom_aabb
    for kind in geometry.PRIMITIVE:
        ids = np.asarray([g for g in sorted(geoms) if model.geom_type[g] == kind], int)
        if len(ids):
            radius = radius.at[ids].set(geometry.rbound(kind, size[ids]))
            box = box.at[ids, 3:].set(geometry.half_extents(kind, size[ids]))
    return {"geom_rbound": radius, "geom_aabb": box}


def _impl(data: mjx.Data, name: str) -> jax.Array:
    """Get a field of Data that newer MJX keeps in the implementation's part."""
    inner = getattr(data, "_impl", None)
    return getattr(inner, name) if inner is not None and hasattr(inner, name) else getattr(data, name)
