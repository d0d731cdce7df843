"""Ground height: the ground under the feet, or the table under the tool, is higher or lower than modelled.

Causes: a carpet, a worn or thicker sole, a table measured by eye, a robot whose height above the floor is off.
"""

import dataclasses
from typing import TYPE_CHECKING, ClassVar

import jax
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.geoms import collidable
from bayessim_mjx.effects.support.site import Site, find
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from mujoco import mjx


@dataclasses.dataclass(frozen=True)
class GroundHeight(Effect):
    """p' = p + height up: all that stands still, carries no joint and can be touched moves along the vertical.

    Up is against gravity (the world's z where there is none). An episode that starts with a foot inside the ground
    pushes it out.

    Parameters: `height`, m, neutral 0.
    """

    where: str | tuple[str, ...] = "world"
    name: ClassVar[str] = "ground_height"
    kind: ClassVar[str] = "world"
    noun: ClassVar[str] = "ground at another height"
    lacks: ClassVar[str] = "the true height of the ground"
    separates: ClassVar[str] = "touching the ground slowly at several places, with the height of the robot measured"
    # how often contacts that are softer or heavier loaded are taken for it has not been counted
    offered: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("height", 0.0, -0.05, 0.05, unit="m", grid=(0.02, 0.1, 0.4)),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        """Bind the site; refuse models without ground that something could touch."""
        if not len(ground(mj_model)):
            raise UserError(f"{self.name}: nothing that stands still in the model can be touched")
        return find(self, mj_model, timestep, substeps)

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        geoms = ground(at.mj_model)
        shift = at.values(theta)[0, 0] * _up(at.mj_model)[geoms]
        return model.replace(geom_pos=model.geom_pos.at[geoms].add(shift))

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        model = spec.compile()
        up = _up(model)
        for own in values.values():
            for i in ground(model):
                geom = spec.geoms[i]
                geom.pos = geom.pos + own["height"] * up[i]
        return None


def ground(model: mujoco.MjModel) -> np.ndarray:
    """Ids of the geoms that can be touched and that no joint moves, but for those of a robot's own base."""
    carries = np.zeros(model.nbody, bool)
    for joint in range(model.njnt):
        body = int(model.jnt_bodyid[joint])
        while body:
            carries[body] = True
            body = int(model.body_parentid[body])
    still = (model.body_weldid == 0) & ~carries & (model.body_mocapid < 0)
    off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return np.flatnonzero(still[model.geom_bodyid] & collidable(model) & (not off))


def _up(model: mujoco.MjModel) -> np.ndarray:
    """`[ngeom, 3]`, the vertical in the frames of the geoms' bodies."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    gravity = np.asarray(model.opt.gravity)
    size = float(np.linalg.norm(gravity))
    up = -gravity / size if size else np.array([0.0, 0.0, 1.0])
    return np.asarray(data.xmat.reshape(-1, 3, 3)[model.geom_bodyid].transpose(0, 2, 1) @ up, np.float32)
