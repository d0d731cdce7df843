"""LuGre friction of joints: bristles that bend before they slip, so that friction is a spring before it is friction.

Causes: asperities and seals that give way, pre-loaded bearings, harmonic drives. Signs: after a reversal friction grows
over a small travel instead of at once, micro-motion is springy, and hysteresis loops have round corners.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Part, Quantity
from bayessim_mjx.effects.support.friction import lose
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    import mujoco

SWEEPS = 2  # over coupled joints, as in `friction.resist`
STIFFEST = 1e-4  # of the bend that a sub-step's force makes in a free joint: less is rigid, and keeps float32 exact
_LEAST = 1e-6  # of the largest friction, and of a speed: keeps quotients finite


@dataclasses.dataclass(frozen=True)
class LugreFriction(Effect):
    """z' = w - s0 |w| z / g(w), F = -(s0 z + s1 z'), g(w) = fc + fs exp(-(w / ws)^2), s0 = (fc + fs) / bend.

    After Canudas de Wit, Olsson, Astrom and Lischinsky (1995), less their viscous term, which `viscous_friction` is and
    mostly the model has. As bend goes to 0 it is `stribeck_friction`. s1 = 2 ratio sqrt(s0 J), J the inertia that is
    felt at the joint. Implicit in w and z, so stable at any sub-step (`resist`).

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
        return start(at)

    def on_start(self, at: Site, memory: Any, motion: Motion, theta: jax.Array) -> tuple[Any, Motion]:
        level, excess, speed, bend = at.values(theta).T
        past = slice(0, motion.start + 1)
        moved = jnp.diff(motion.qpos[past, at.qadr], axis=0)
        steady = sliding(moved / jnp.float32(at.dt), level, excess, speed)
        return wound(memory, moved, steady, level + excess, bend), motion

    def on_force(self, at: Site, memory: Any, step: SubStep, theta: jax.Array) -> tuple[Any, jax.Array]:
        level, excess, speed, bend = at.values(theta).T
        steady = sliding(step.qvel[at.dadr], level, excess, speed)
        return resist(at, memory, step, steady, level + excess, bend, self.ratio)

    def edit(self, spec: "mujoco.MjSpec", values: dict[str, dict[str, float]]) -> str | None:
        """Write its level alone, as frictionloss."""
        lose(spec, values)
        return Part("presliding and the excess at low speed, which MuJoCo's joints do not have; use effects.yaml")


def start(at: Site) -> dict[str, jax.Array]:
    """Memory of a joint of which nothing was seen.

    `force` is f as a share of the largest friction there is, `unknown` the share of it that nobody saw yet, which
    counts as what held the load.
    """
    return {"force": jnp.zeros(len(at)), "unknown": jnp.ones(len(at))}


def sliding(w: jax.Array, level: jax.Array, excess: jax.Array, speed: jax.Array) -> jax.Array:
    """g(w), friction in steady motion."""
    return level + excess * jnp.exp(-((w / jnp.maximum(speed, _LEAST)) ** 2))


def wound(memory: Any, moved: jax.Array, friction: jax.Array, most: jax.Array, bend: jax.Array) -> dict[str, jax.Array]:
    """Memory after a recorded motion; exact where the speed is constant between rows.

    Args:
        moved: `[rows, n]`, from row to row, rad or m; friction: `[rows, n]`, g in between.
        most: `[n]`, largest g; bend: `[n]`, of the bristles under it.
    """
    safe = jnp.where(most > 0, most, 1.0)
    way, level = moved / jnp.maximum(bend, 1e-9), jnp.maximum(friction / safe, _LEAST)

    def advance(now: tuple, row: tuple) -> tuple[tuple, None]:
        force, unknown = now
        way, level = row
        kept = jnp.exp(-jnp.abs(way) / level)
        return (kept * force + (1.0 - kept) * level * jnp.sign(way), kept * unknown), None

    (force, unknown), _ = jax.lax.scan(advance, (memory["force"], memory["unknown"]), (way, level))
    return {"force": force, "unknown": unknown}


def resist(
    at: Site, memory: Any, step: SubStep, friction: jax.Array, most: jax.Array, bend: jax.Array, ratio: float
) -> tuple[dict[str, jax.Array], jax.Array]:
    """(memory, generalised force `[nv]`) of F = -(f + s1 z'), f and w at the *end* of the sub-step.

    With the bristles' compliance c = bend / most, f = (c f0 + dt w) / (c + dt |w| / g) is put into the joint's
    w = v - k ((1 + s) f - s f0), k = dt / inertia and s = s1 c / dt, which is then quadratic in w with one root on the
    side where the joint goes: no step is too long. Coupled joints: Gauss-Seidel from the forces of the last sub-step.

    Args:
        friction: `[n]`, g; most: `[n]`, its largest value, 0: no friction at all; bend: `[n]`, rad or m.
        ratio: damping ratio of the bristles, s1 = 2 ratio sqrt(inertia / c).
    """
    inverse, dt = step.inverse, jnp.float32(step.dt)
    on = most > 0
    limit = jnp.where(on, most, 1.0)
    g = jnp.where(on, jnp.maximum(friction, _LEAST * limit), 1.0)
    gain = dt * jnp.diagonal(inverse)[at.dadr]  # k
    compliance = jnp.maximum(bend / limit, STIFFEST * gain * dt)
    share = 2.0 * ratio * jnp.sqrt(compliance * dt / gain) / dt  # s
    force = step.last[at.dadr]
    speed = step.qvel[at.dadr] + dt * (inverse * (step.force + at.scatter(force))).sum(-1)[at.dadr]
    held = jnp.clip((speed - gain * force) / gain, -g, g)  # what would hold the joint, without its damping
    before = memory["force"] * limit + memory["unknown"] * held
    bent = before
    for _ in range(SWEEPS if len(at) > 1 else 1):
        for i, dof in enumerate(at.dadr):
            free = speed[i] - gain[i] * force[i]
            bent_i = _slip(free, before[i], g[i], gain[i], compliance[i], share[i], dt)
            new = jnp.where(on[i], -((1.0 + share[i]) * bent_i - share[i] * before[i]), 0.0)
            speed = speed + dt * inverse[at.dadr, dof] * (new - force[i])
            force, bent = force.at[i].set(new), bent.at[i].set(bent_i)
    memory = {"force": jnp.where(on, bent / limit, 0.0), "unknown": jnp.zeros(len(at))}
    return memory, at.scatter(force)


def _slip(
    free: jax.Array, before: jax.Array, g: jax.Array, gain: jax.Array, soft: jax.Array, share: jax.Array, dt: jax.Array
) -> jax.Array:
    """f at the end of the sub-step of one joint; free: its speed there without friction."""
    drive = free + gain * share * before  # w + k (1 + s) f = drive
    pull = gain * (1.0 + share)
    side = jnp.where(drive >= pull * before, 1.0, -1.0)
    # with u = |w|:  a u^2 + b u = c (all signs of `side` taken out), a, c >= 0
    a, c = dt / g, soft * side * (drive - pull * before)
    b = soft + dt * (pull - side * drive / g)
    root = jnp.sqrt(b * b + 4.0 * a * c)
    u = jnp.where(b > 0, 2.0 * c / jnp.where(b > 0, b + root, 1.0), (root - b) / (2.0 * a))
    return (soft * before + dt * side * u) / (soft + dt * u / g)
