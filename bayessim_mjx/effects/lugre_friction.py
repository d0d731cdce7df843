"""LuGre friction of joints: bristles that bend before they slip, so that friction is a spring before it is friction.

Causes: asperities and seals that give way, pre-loaded bearings, harmonic drives. Signs: after a reversal friction grows
over a small travel instead of at once, micro-motion is springy, and hysteresis loops have round corners.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support import bristles
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    import mujoco


@dataclasses.dataclass(frozen=True)
class LugreFriction(Effect):
    """z' = w - s0 |w| z / g(w), F = -(s0 z + s1 z'), g(w) = fc + fs exp(-(w / ws)^2), s0 = (fc + fs) / bend.

    After Canudas de Wit, Olsson, Astrom and Lischinsky (1995), less their viscous term, which `viscous_friction` is and
    mostly the model has. As bend goes to 0 it is `stribeck_friction`. s1 = 2 ratio sqrt(s0 J), J the inertia that is
    felt at the joint. Implicit in w and z, so stable at any sub-step (`bristles.resist`).

    Parameters: `level` fc and `excess` fs, N m (hinge) or N (slide), neutral 0; `speed` ws, rad/s or m/s, and `bend`,
    rad or m, how far the bristles give way to level and excess; both without effect where fc = fs = 0.

    Attributes:
        ratio: damping ratio of the joint on its bristles, no unit, from 0.
    """

    ratio: float = 0.7
    name: ClassVar[str] = "lugre_friction"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "friction with presliding (LuGre)"
    separates: ClassVar[str] = "reversals and steps below the presliding travel, by an encoder that resolves it"
    contains: ClassVar[tuple[str, ...]] = ("coulomb_friction", "stribeck_friction")
    # it shows within fractions of a degree after reversals: few encoders tell it from Stribeck friction, and more
    # numbers at every joint cost every diagnosis
    offered: ClassVar[bool] = False
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("level", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0)),
        Quantity("excess", 0.0, 0.0, 1.0, unit="N m", per="force", reach=(0.0, 1.0), grid=(0.15,)),
        Quantity(
            "speed", 0.1, 0.01, 1.0, unit="rad/s", per="speed", reach=(0.01, 0.5),
            prior="loguniform", grid=(0.2,), shape=True,
        ),
        Quantity(
            "bend", 0.005, 0.0001, 0.1, unit="rad", per="travel", reach=(0.0001, 0.3),
            prior="loguniform", grid=(0.003, 0.03, 0.2), shape=True,
        ),
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.ratio < float("inf"):
            raise UserError(f"{self.name}: ratio = {self.ratio}; allowed: from 0 (bristles without damping) upwards")

    def init(self, at: Site) -> Any:
        return bristles.start(at)

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        level, excess, speed, bend = at.values(theta).T
        past = slice(0, motion.start + 1)
        moved = jnp.diff(motion.qpos[past, at.qadr], axis=0)
        steady = bristles.steady(moved / jnp.float32(at.dt), level, excess, speed)
        return bristles.wound(memory, moved, steady, level + excess, bend), motion

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        level, excess, speed, bend = at.values(theta).T
        steady = bristles.steady(step.qvel[at.dadr], level, excess, speed)
        return bristles.resist(at, memory, step, steady, level + excess, bend, self.ratio)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        return "MuJoCo's joints have no friction with presliding; use effects.yaml"
