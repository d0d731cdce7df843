"""Stretching bodies along their long axis: which axis, and what bounds a geom has. NumPy or JAX arrays alike."""

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import attributes

Geom = mujoco.mjtGeom
SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID = (
    int(getattr(Geom, f"mjGEOM_{n}")) for n in ("SPHERE", "CAPSULE", "CYLINDER", "BOX", "ELLIPSOID")
)
PRIMITIVE = (SPHERE, CAPSULE, CYLINDER, BOX, ELLIPSOID)


def rotation(quat: Any, xp: Any = jnp) -> Any:
    """Convert unit quaternions `[..., 4]` (w, x, y, z) to rotation matrices `[..., 3, 3]`."""
    w, x, y, z = (quat[..., i] for i in range(4))
    return xp.stack(
        [
            xp.stack([w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            xp.stack([2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)], -1),
            xp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], -1),
        ],
        -2,
    )


def half_extents(kind: int, size: Any) -> Any:
    """Half extents of a primitive along its own axes, `[3]`."""
    if kind == SPHERE:
        return size[..., [0, 0, 0]]
    if kind == CAPSULE:
        return size[..., [0, 0, 1]] + size[..., [0]] * np.array([0, 0, 1], np.float32)
    if kind == CYLINDER:
        return size[..., [0, 0, 1]]
    return size


def rbound(kind: int, size: jax.Array) -> jax.Array:
    """Radius of the bounding sphere of a primitive, as MuJoCo's compiler sets it."""
    if kind == SPHERE:
        return size[..., 0]
    if kind == CAPSULE:
        return size[..., 0] + size[..., 1]
    if kind == CYLINDER:
        return jnp.sqrt(size[..., 0] ** 2 + size[..., 1] ** 2)
    if kind == BOX:
        return jnp.sqrt(jnp.sum(size**2, -1))
    return jnp.max(size, -1)


def long_axis(model: Any, body: int, label: str = "length") -> tuple[float, float, float]:
    """Find the unit vector in the body frame along which the body is longest.

    The axis of its longest geom; for spheres or without geoms the direction of the centre of mass, else of a child.

    Raises:
        UserError: under `jit` with a traced model; for meshes; if the body has no direction; if the axis is no
            principal axis of inertia (stretching would turn the inertial frame).
    """
    try:
        read = {k: np.asarray(getattr(model, k), np.float64) for k in _CONCRETE}
    except jax.errors.TracerArrayConversionError:
        raise UserError(f"{label}: the model is traced; give the Parameter its `axis`") from None
    axis = _direction(model, body, read, label)
    axis = np.where(abs(axis) < 1e-6, 0.0, axis)
    axis = axis / np.linalg.norm(axis)
    frame = rotation(read["body_iquat"][body], np)
    inertia = read["body_inertia"][body]
    if float(np.ptp(inertia)) > 1e-6 * float(inertia.max()) and abs(frame.T @ axis).max() < 1 - 1e-6:
        raise UserError(f"{label}: the long axis {axis.tolist()} is no principal axis of the body's inertia")
    x, y, z = (float(a) for a in axis)
    return x, y, z


_CONCRETE = ("geom_size", "geom_quat", "body_ipos", "body_iquat", "body_inertia", "body_pos")


def _direction(model: Any, body: int, read: dict[str, np.ndarray], label: str) -> np.ndarray:
    best, axis = 0.0, None
    for g in np.flatnonzero(np.asarray(model.geom_bodyid) == body):
        kind = int(model.geom_type[g])
        if kind not in PRIMITIVE:
            raise UserError(f"{label}: geom {attributes.names(model, 'geom')[g]} is no primitive; it has no length")
        extents = half_extents(kind, read["geom_size"][g])
        if kind != SPHERE and extents.max() > best:
            best, axis = float(extents.max()), rotation(read["geom_quat"][g], np)[:, int(extents.argmax())]
    if axis is not None:
        return axis
    children = [c for c in np.flatnonzero(np.asarray(model.body_parentid) == body) if c != 0]
    for candidate in [read["body_ipos"][body], *(read["body_pos"][c] for c in children)]:
        if np.linalg.norm(candidate) > 1e-9:
            return candidate / np.linalg.norm(candidate)
    raise UserError(f"{label}: the body has neither a long geom nor an offset that would give it a direction")


# Reach of a load beyond its body's centre of mass, the scale of an unknown payload's place: of the body's own size, of
# the robot's length. Rules of thumb, not measured.
BESIDE, OUT = 1.2, 0.3


def tree_mass(model: mujoco.MjModel, body: int) -> float:
    """kg of all that moves in the body's tree."""
    own = (model.body_rootid == model.body_rootid[body]) & (model.body_weldid != 0)
    return float(model.body_mass[own].sum())


def reach(model: mujoco.MjModel, body: int) -> float:
    """m from the body's centre of mass to that of what it may carry: beyond the body itself, a tool's length."""
    return max(BESIDE * body_size(model, body), OUT * _longest_chain(model, body))


def _longest_chain(model: mujoco.MjModel, body: int) -> float:
    """m, the longest chain of the body's tree, stretched out."""
    length = np.zeros(model.nbody)
    for b in range(1, model.nbody):
        above = int(model.body_parentid[b])
        length[b] = length[above] + (np.linalg.norm(model.body_pos[b]) if above else 0.0)
    own = np.flatnonzero(model.body_rootid == model.body_rootid[body])
    return max((float(length[b]) + body_size(model, int(b)) for b in own if b), default=0.0)


def body_size(model: mujoco.MjModel, body: int) -> float:
    """m from the body's centre of mass to the farthest end of its geoms, or where a body joins."""
    centre = model.body_ipos[body]
    own = np.flatnonzero((model.geom_bodyid == body) & (model.geom_type != int(mujoco.mjtGeom.mjGEOM_PLANE)))
    ends = [np.linalg.norm(model.geom_pos[g] - centre) + model.geom_rbound[g] for g in own]
    joined = np.flatnonzero(model.body_parentid == body)
    ends += [np.linalg.norm(model.body_pos[b] - centre) for b in joined if b != body]
    return max([float(r) for r in ends], default=0.0) or 0.1
