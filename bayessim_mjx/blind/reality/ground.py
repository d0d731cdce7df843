"""Ground: what stands still in a model and can be touched."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np


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
