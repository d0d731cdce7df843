"""Whether a model's geoms can touch each other at all."""

import itertools

import mujoco


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
