"""Cogging and torque ripple: a force periodic in the angle (magnets against slots, gear teeth, wave generator)."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.linalg import product

# With fewer periods in the range of motion (or per turn) it is any smooth force: of gravity, a spring, a rough place.
# A fit finds the order only from nearby: start at the usual ones
_LEAST, _MOST = 1.5 * math.pi, 30 * math.pi
_ORDERS = (2, 3, 4, 5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 24, 27, 30, 33, 36, 40, 44, 48, 54, 60)


@dataclasses.dataclass(frozen=True)
class Cogging(Effect):
    """f = sine sin(n x) + cosine cos(n x) through the actuator's transmission; x is its length (gear times angle).

    Sine and cosine instead of amplitude and phase: linear, and no wrap. It also acts while the drive is off, and no
    limit or gain of the actuator changes it.

    Parameters:
        sine, cosine: N m (hinge) or N (slide), neutral 0.
        order: n, periods per revolution (per 2 pi of x), without effect where both amplitudes are 0.
    """

    name: ClassVar[str] = "cogging"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "cogging"
    separates: ClassVar[str] = "constant slow speeds at several values"
    witness: ClassVar[tuple[str, str] | None] = ("current", "motor current (`current:<actuator>`)")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("sine", 0.0, -1.0, 1.0, unit="N m", per="force", reach=(-1.0, 1.0), grid=(0.03,)),
        Quantity("cosine", 0.0, -1.0, 1.0, unit="N m", per="force", reach=(-1.0, 1.0), grid=(0.03,)),
        Quantity(
            "order",
            2.0,
            2.0,
            60.0,
            unit="1/rev",
            per="1/travel",  # travel is half the range of motion
            reach=(_LEAST, _MOST),
            grid=tuple((n - 2) / 58 for n in _ORDERS),
            shape=True,
            at_least=True,
        ),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        sine, cosine, order = at.values(theta).T
        angle = order * step.data.actuator_length[at.ids]
        force = sine * jnp.sin(angle) + cosine * jnp.cos(angle)
        return memory, product(force[None], step.data._impl.actuator_moment[at.ids])[0]
