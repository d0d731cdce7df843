"""A force from outside on a body: wind, a hanging cable or hose, suction, a hand that leans on the robot."""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.bodies import project, velocity
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco

TINY = 1e-12  # N


@dataclasses.dataclass(frozen=True)
class ExternalForce(Effect):
    """f = |F| |e - kappa v| (e - kappa v), e = F / |F|, at the body's centre of mass, which moves with v.

    Constant where kappa = 0; else the drag of a steady wind of speed 1 / kappa along e, F being its force on the body
    at rest.

    Parameters: `force_x`, `force_y`, `force_z`, N, world frame, neutral 0; `inverse_speed` kappa, s/m, >= 0.
    """

    name: ClassVar[str] = "external_force"
    kind: ClassVar[str] = "body"
    noun: ClassVar[str] = "external force"
    lacks: ClassVar[str] = "an external force"
    separates: ClassVar[str] = "the robot turned round in the room; the same motion in another direction"
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("force_x", 0.0, -10.0, 10.0, unit="N", per="weight", reach=(-0.3, 0.3)),
        Quantity("force_y", 0.0, -10.0, 10.0, unit="N", per="weight", reach=(-0.3, 0.3)),
        Quantity("force_z", 0.0, -10.0, 10.0, unit="N", per="weight", reach=(-0.3, 0.3)),
        Quantity("inverse_speed", 0.0, 0.0, 0.5, unit="s/m", grid=(0.0, 0.2), shape=True),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        still, slowness = at.values(theta)[:, :3], at.values(theta)[:, 3:]
        square = jnp.sum(still * still, axis=1, keepdims=True)
        size = jnp.sqrt(jnp.where(square > 0, square, TINY))  # where: the root has no slope at 0
        along = still / size - slowness * velocity(at.mj_model, step.data, at.ids)
        fast = jnp.sum(along * along, axis=1, keepdims=True)
        wind = size * jnp.sqrt(jnp.where(fast > 0, fast, TINY)) * along
        force = jnp.where((slowness > 0) & (square > 0), wind, still)
        return memory, project(at.mj_model, step.data, at.ids, force)

    def rates(self, at: Site, memory: Any) -> dict[str, jax.Array]:
        return {}

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo applies forces to bodies at run time (xfrc_applied), not in the model; use effects.yaml"
