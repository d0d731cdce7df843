"""Joint offset: an encoder whose zero is off, by mounting, homing or a tooth skipped by a belt."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.effects.effect import Effect, Measurement, Quantity
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site

if TYPE_CHECKING:
    from mujoco import mjx

_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_AFFINE = int(mujoco.mjtBias.mjBIAS_AFFINE)


@dataclasses.dataclass(frozen=True)
class JointOffset(Effect):
    """measured = q + o, also for the joint's own position servo, whose command c then acts as c - o.

    A servo's force is gain c + b1 gear (q + o): its command shifts by b1 gear o / gain (-o for a position servo), and
    its ctrlrange with it. Controllers that a log declares (`laws`) know the sensors' static error themselves.

    Parameters: `offset` o, rad (hinge) or m (slide), neutral 0.
    """

    name: ClassVar[str] = "joint_offset"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "angle offset"
    lacks: ClassVar[str] = "an angle offset"
    separates: ClassVar[str] = "two mount orientations; a mechanical stop as the reference"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("offset", 0.0, -0.1, 0.1, unit="rad", per="travel", reach=(-0.1, 0.1)),
    )

    def on_model(self, at: Site, model: "mjx.Model", theta: jax.Array) -> "mjx.Model":
        servos, shift = _shift(at, theta)
        if not len(servos):
            return model
        return model.replace(actuator_ctrlrange=model.actuator_ctrlrange.at[servos].add(shift[:, None]))

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        servos, shift = _shift(at, theta)
        return memory, command.at[:, servos].add(shift) if len(servos) else command

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        return memory, motion.replace(qpos=motion.qpos.at[:, at.qadr].add(-at.values(theta)[:, 0]))

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        return memory, measurement | {"qpos": measurement["qpos"].at[at.qadr].add(at.values(theta)[:, 0])}

    def edit(self, spec: mujoco.MjSpec, values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's joint sensors have no zero of their own; use effects.yaml"


def _shift(at: Site, theta: jax.Array) -> tuple[np.ndarray, jax.Array]:
    """(ids of actuators that close a loop on the position of a joint of the site, by how much their commands shift)."""
    model = at.mj_model
    gain, slope = model.actuator_gainprm[:, 0], model.actuator_biasprm[:, 1]
    loop = (model.actuator_biastype == _AFFINE) & (slope != 0) & (gain != 0)
    joint = np.where(np.isin(model.actuator_trntype, _ON_JOINT), model.actuator_trnid[:, 0], -1)
    servos = np.flatnonzero(loop & np.isin(joint, at.ids))
    place = np.asarray([list(at.ids).index(j) for j in joint[servos]], int)
    factor = slope[servos] * model.actuator_gear[servos, 0] / gain[servos]
    return servos, jnp.asarray(factor, jnp.float32) * at.values(theta)[place, 0]
