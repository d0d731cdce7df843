"""Load-dependent friction of joints: dry friction that grows with the torque that the gear transmits.

Causes: teeth pressed together, axial load on bearings, worm gears. It differs between lifting and lowering, and holds
arms in place under gravity; a motor's and a load's torque need not count alike (directional gears).
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import dry
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class LoadFriction(Effect):
    """F = -(cm |tau_m| + ce |tau_e|) sgn(w), set-valued at rest; see `friction.dry`.

    tau_m: force of all actuators on the joint, effects on actuators included. tau_e: what gravity, Coriolis forces,
    springs and fluid press on the joint, without its own damping (a loss of the gear, no load) and without inertial
    forces (not known before friction is), as in Rhoban's BAM (2025).

    Parameters: `motor` cm and `external` ce, dimensionless, neutral 0.
    """

    name: ClassVar[str] = "load_friction"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "load-dependent friction"
    separates: ClassVar[str] = "two payloads or arm angles; lifting and then letting drop with the drive off"
    witness: ClassVar[tuple[str, str] | None] = (
        "effort",
        "a torque sensor on the link side, or the motor current (`effort:<actuator>`)",
    )
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("motor", 0.0, 0.0, 0.6, most=1.0),
        Quantity("external", 0.0, 0.0, 0.6, most=1.0),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        motor, external = at.values(theta).T
        data = step.data
        load = data.qfrc_passive + step.model.dof_damping * step.qvel - data.qfrc_bias
        level = motor * jnp.abs(data.qfrc_actuator[at.dadr]) + external * jnp.abs(load[at.dadr])
        return memory, dry(at, step, level)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's joint friction does not grow with the load; use effects.yaml"
