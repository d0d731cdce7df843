"""Models without geoms that only show a robot, as it is simulated, and without meshes, as its names are read."""

import copy
import itertools

import mujoco
import numpy as np

from bayessim_mjx.effects.support.bodies import whole_inertia
from bayessim_mjx.effects.support.geoms import collidable
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.editing import state

_MESH, _RAY = int(mujoco.mjtGeom.mjGEOM_MESH), int(mujoco.mjtSensor.mjSENS_RANGEFINDER)
_GEOM, _WRAPS = int(mujoco.mjtObj.mjOBJ_GEOM), (mujoco.mjtWrap.mjWRAP_SPHERE, mujoco.mjtWrap.mjWRAP_CYLINDER)


def idle(model: mujoco.MjModel) -> np.ndarray:
    """`[ngeom]` bool: geoms that touch nothing, that nothing refers to, and that no fluid carries."""
    if model.opt.density or model.opt.viscosity or _sensed(model):
        return np.zeros(model.ngeom, bool)
    wrapped = model.wrap_objid[np.isin(model.wrap_type, [int(w) for w in _WRAPS])]
    return ~(collidable(model) | np.isin(np.arange(model.ngeom), wrapped))


def _sensed(model: mujoco.MjModel) -> bool:
    """Whether sensors see geoms."""
    kinds = model.sensor_objtype, model.sensor_reftype
    return bool((model.sensor_type == _RAY).any() or any((kind == _GEOM).any() for kind in kinds))


def without_visuals(spec: mujoco.MjSpec, model: mujoco.MjModel) -> mujoco.MjModel:
    """Return the model without its idle geoms, if meshes are among them: masses and inertias to the bit those it has.

    Geoms that remain keep their names, also those that are only counted (`geom7`). A model without such meshes stays
    as it is, so that its programs and their roundings do.

    Args:
        spec: it is not changed; model: what it compiles to.
    """
    out = idle(model)
    if not np.any(out & (model.geom_type == _MESH)):
        return model
    spec = spec.copy()
    for body in spec.bodies[1:]:
        if model.body_mass[body.id]:
            state(body, model)
    for geom in spec.geoms:
        geom.name = geom.name or f"geom{geom.id}"
    spec.compiler.discardvisual = True
    compiler, auto = spec.compiler, mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.settotalmass, compiler.balanceinertia, compiler.boundmass, compiler.boundinertia = -1.0, False, 0.0, 0.0
    compiler.inertiafromgeom = auto
    return whole_inertia(spec, spec.compile())


def needs_geoms(space: ParameterSpace) -> bool:
    """Whether a parameter is of geoms, or changes a body along the axis of one."""
    return any(p.kind in ("geom", "actor") or p.attribute == "length" for p in space.parameters)


def without_meshes(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a copy with spheres in the place of meshes: names, joints and actuators are right, masses are not."""
    spec = spec.copy()
    for geom in spec.geoms:
        if geom.meshname:
            geom.type, geom.meshname, geom.size = mujoco.mjtGeom.mjGEOM_SPHERE, "", [0.1, 0.0, 0.0]
    for shape in (*spec.meshes, *spec.skins):
        spec.delete(shape)
    return spec.compile()


def with_options(model: mujoco.MjModel, other: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy with the options of another one."""
    model = copy.copy(model)
    for name in (name for name in dir(other.opt) if not name.startswith("_")):
        setattr(model.opt, name, getattr(other.opt, name))
    return model


# Whether a model's geoms can touch each other at all


def collides(model: mujoco.MjModel) -> bool:
    """Whether MuJoCo may make a contact in some pose: by declared pairs, or by the geoms' classes.

    Geoms of one body, of bodies that are welded together, of a body and its parent (but for the world's) and of
    excluded pairs of bodies never touch (MuJoCo's documentation, Collision detection).
    """
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        return False
    if model.npair:
        return True
    excluded = {int(signature) for signature in model.exclude_signature}
    weld, parent = model.body_weldid, model.body_parentid
    for a, b in itertools.combinations(range(model.ngeom), 2):
        kinds = model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]
        one, two = sorted(int(model.geom_bodyid[g]) for g in (a, b))
        first, second = int(weld[one]), int(weld[two])
        if not kinds or first == second or (one << 16) + two in excluded:
            continue
        related = first and second and (int(weld[parent[second]]) == first or int(weld[parent[first]]) == second)
        if not related:
            return True
    return False
