"""Coulomb (dry) friction of joints, with real sticking or, with a relaxation, as soft as MuJoCo's frictionloss.

It needs no rows of MuJoCo's solver, and its level may be zero.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.friction import Soft, dry, lose
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class CoulombFriction(Effect):
    """F = -level sgn(w), set-valued at rest; see `friction.dry`.

    Parameters: `level`, N m (hinge) or N (slide), neutral 0; `relaxation`, s, neutral 0 and optional: the time
    constant of MuJoCo's soft friction (`solreffriction`; see `friction.Soft`), without effect where the level is 0.

    Attributes:
        high: upper limit of the level, N m or N, unless `parameters` has another range.
    """

    high: float = 1.0
    name: ClassVar[str] = "coulomb_friction"
    kind: ClassVar[str] = "joint"
    effort: ClassVar[str] = "dry"
    noun: ClassVar[str] = "Coulomb friction"
    separates: ClassVar[str] = "slow triangles at three speeds and with two payloads"
    witness: ClassVar[tuple[str, str] | None] = ("temperature", "temperature of motor or gearbox (`temperature`)")
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("level", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        # up to twice MuJoCo's default
        Quantity("relaxation", 0.0, 0.0, 0.04, unit="s", grid=(0.0,), shape=True, optional=True),
    )

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        level, *relaxation = at.values(theta).T
        return memory, dry(at, step, level, Soft(at, step, *relaxation) if relaxation else None)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Native: frictionloss."""
        lose(spec, values)
        return None
