"""Friction by bristles that bend and slip (LuGre), solved together with the joint at the end of the sub-step.

The force of the bristles f = s0 z follows f' = s0 (w - |w| f / g). Its memory is `force`, f as a share of `most`, the
largest friction there is; and `unknown`: how much of it is what nobody saw yet, which counts as what held the load.
"""

from typing import Any

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.support.site import Site
from bayessim_mjx.effects.support.substep import SubStep

SWEEPS = 2  # over coupled joints, as in `friction.resist`
STIFFEST = 1e-4  # of the bend that a sub-step's force makes in a free joint: less is rigid, and keeps float32 exact
_LEAST = 1e-6  # of the largest friction, and of a speed: keeps quotients finite


def start(at: Site) -> dict[str, jax.Array]:
    """Memory of a joint of which nothing was seen."""
    return {"force": jnp.zeros(len(at)), "unknown": jnp.ones(len(at))}


def steady(w: jax.Array, level: jax.Array, excess: jax.Array, speed: jax.Array) -> jax.Array:
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
