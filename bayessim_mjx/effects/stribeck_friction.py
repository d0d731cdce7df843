"""Stribeck friction of joints: dry friction that is larger near standstill, where the lubricant is squeezed out.

Causes: boundary lubrication of gears, seals and plain bearings. Sign: stick-slip in slow motion.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Part, Quantity
from bayessim_mjx.effects.support.friction import dry, lose
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco

_SLOWEST = 1e-6  # keeps w / ws finite


@dataclasses.dataclass(frozen=True)
class StribeckFriction(Effect):
    """F = -(fc + fs exp(-(w / ws)^2)) sgn(w), up to fc + fs at rest; see `friction.dry`.

    Parameters: `level` fc and `excess` fs, N m (hinge) or N (slide), neutral 0; `speed` ws, rad/s or m/s, without
    effect where fs = 0.
    """

    name: ClassVar[str] = "stribeck_friction"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "Stribeck friction"
    separates: ClassVar[str] = "a sweep of speeds through the suspected Stribeck speed, several crossings"
    contains: ClassVar[tuple[str, ...]] = ("coulomb_friction",)
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("level", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        Quantity("excess", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        Quantity(
            "speed",
            0.1,
            0.01,
            1.0,
            unit="rad/s",
            per="speed",
            reach=(0.01, 0.5),
            prior="loguniform",
            grid=(0.03, 0.2, 0.6),
            shape=True,
        ),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        level, excess, speed = at.values(theta).T
        share = jnp.exp(-((step.qvel[at.dadr] / jnp.maximum(speed, _SLOWEST)) ** 2))
        return memory, dry(at, step, level + excess * share)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Its level alone, as frictionloss."""
        lose(spec, values)
        return Part(
            "its excess at low speed, as MuJoCo's joint friction does not depend on the speed; use effects.yaml"
        )
