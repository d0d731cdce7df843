"""What a model consists of: links, whether and about which axis they turn; and ground that can be touched."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np


def turns(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body with joints of its own and mass is turned, alone or with those before it."""
    diagonal = model.body_dofnum[body] > 1 and model.body_simple[body] == 1  # compiled so: no other inertia is taken
    if model.body_weldid[body] != body or model.body_mass[body] <= 0 or diagonal:
        return False
    while body:
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        if any(int(k) != int(mujoco.mjtJoint.mjJNT_SLIDE) for k in model.jnt_type[first : first + count]):
            return True
        body = int(model.body_parentid[body])
    return False


def length(model: mujoco.MjModel, body: int) -> float:
    """m, of a rod of the same mass and largest inertia: m l^2 / 12."""
    return float(np.sqrt(12 * model.body_inertia[body].max() / model.body_mass[body]))


def axis(model: mujoco.MjModel, body: int) -> np.ndarray:
    """`[3]`, of the one hinge that a body has, in its frame; zeros where it has none, or several."""
    own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    hinges = [i for i in own if int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_HINGE)]
    return model.jnt_axis[hinges[0]].copy() if len(hinges) == 1 else np.zeros(3)


def chain(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, tuple[str, str]]:
    """(joint before, first joint behind) of each; a joint of another kind in between parts them."""
    before: dict[str, str] = {}
    for name in joints:
        at = model.joint(name).id
        body = int(model.jnt_bodyid[at])
        way = [i for i in range(model.body_jntadr[body], at)]  # those of its own body that come first
        while not way and body:
            body = int(model.body_parentid[body])
            way = list(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))
        last = model.joint(way[-1]).name if way else ""
        before[name] = last if last in joints else ""
    behind = {other: name for name, other in reversed(before.items()) if other}
    return {name: (before[name], behind.get(name, "")) for name in joints}


def ground(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    """Geoms that can be touched and that no joint moves, but for those of a body that carries joints."""
    if int(spec.option.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return []
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    every = [*spec.worldbody.geoms, *(g for body in spec.worldbody.bodies for g in _still(body))]
    return [g for g in every if g.contype or g.conaffinity or (g.name and g.name in paired)]


def _still(body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    if body.joints or body.mocap:
        return
    if not _carries(body):
        yield from body.geoms
    for child in body.bodies:
        yield from _still(child)


def _carries(body: mujoco.MjsBody) -> bool:
    return bool(body.joints) or any(_carries(child) for child in body.bodies)


def lift(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom], way: np.ndarray) -> None:
    """Move geoms by `way` in the world, however bodies and frames above them are turned."""
    was = [(np.array(g.pos), np.array(g.fromto)) for g in geoms]

    def put(ways: np.ndarray) -> None:
        for g, (pos, ends), own in zip(geoms, was, ways, strict=True):
            g.pos, g.fromto = pos + own, ends + np.tile(own, 2)  # the second one is NaN where it is not used

    before, axes = _places(spec, geoms), []
    for unit in np.eye(3):
        put(np.tile(unit, (len(geoms), 1)))
        axes.append(_places(spec, geoms) - before)
    put(np.einsum("knw,w->nk", np.array(axes), way))  # the axes are those of a rotation


def _places(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom]) -> np.ndarray:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom_xpos[g.id] for g in geoms])
