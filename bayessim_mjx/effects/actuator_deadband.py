"""Actuator dead band: too small a command does nothing (least duty that moves a motor, servo tolerance, valve lap)."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.quantity import EFFORT
from bayessim_mjx.effects.support.site import Site, ranges
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError

_FIXED = int(mujoco.mjtGain.mjGAIN_FIXED)
_NONE, _AFFINE = int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)


@dataclasses.dataclass(frozen=True)
class ActuatorDeadband(Effect):
    """dz(e; h) = sgn(e) max(|e| - h, 0) in the place of what the actuator acts on, e.

    e is the command of a force or velocity actuator, and the error c - q of a position servo. Computed before
    MuJoCo's force limit; effects that change the force come after it in the stack.

    Parameters: `half_width` h, in the unit of the actuator's ctrl (rad for a position servo of a hinge), neutral 0.

    Attributes:
        high: largest half-width, unless `parameters` has another range.
    """

    high: float = 0.2
    name: ClassVar[str] = "actuator_deadband"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "command deadband"
    lacks: ClassVar[str] = "a command deadband"
    separates: ClassVar[str] = "slow ramps and holds with the drive's measured effort in the log"
    witness = EFFORT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "half_width",
            0.0,
            0.0,
            0.2,
            unit="ctrl",
            per="command",
            reach=(0.0, 0.3),
            grid=(0.01, 0.05, 0.2),
            half="band",
        ),
    )

    def bind(self, mj_model: mujoco.MjModel, timestep: float, substeps: int) -> Site:
        at = super().bind(mj_model, timestep, substeps)
        gains, biases = mj_model.actuator_gaintype[at.ids], mj_model.actuator_biastype[at.ids]
        for name, gain, bias in zip(at.names, gains, biases, strict=True):
            if gain != _FIXED or bias not in (_NONE, _AFFINE):
                allowed = "motor, position, velocity ..."
                raise UserError(f"{self.name}: actuator {name!r} has no fixed gain; allowed: {allowed}")
        return at

    def on_actuator(
        self, at: Site, memory: Any, step: SubStep, force: jax.Array, theta: jax.Array
    ) -> tuple[Any, jax.Array]:
        half = at.values(theta)[:, 0]
        model, length = step.model, step.data.actuator_length[at.ids]
        stiffness = jnp.where(at.mj_model.actuator_biastype[at.ids] == _AFFINE, model.actuator_biasprm[at.ids, 1], 0.0)
        gain, full = model.actuator_gainprm[at.ids, 0], step.asked[at.ids]
        error, band = gain * step.signal[at.ids] + stiffness * length, jnp.abs(gain) * half  # gain e
        low, high = ranges(model.actuator_forcelimited[at.ids], model.actuator_forcerange[at.ids])
        change = jnp.clip(full - jnp.clip(error, -band, band), low, high) - jnp.clip(full, low, high)
        return memory, force.at[at.ids].add(jnp.where(half > 0, change, 0.0))
