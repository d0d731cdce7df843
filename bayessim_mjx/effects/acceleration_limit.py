"""Motion profile of a drive: its set-point runs after the command with limited speed and acceleration.

Causes: the trapezoidal profile generator of smart servos and motion controllers. Sign: large steps arrive late by a
time that grows with the root of the step, small ones are smoothed.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Quantity
from bayessim_mjx.effects.support.quantity import SET_POINT
from bayessim_mjx.effects.support.site import Site

SOFT = 1e-12  # of inertness, in squared units of time: what is quicker counts as a jump, and 1 / b overflows
SHORT = 2.0**-23  # of time: what float32 cannot place within a unit; a power of two, so that rest is exact
STILL = 1e-9  # of slowness, in units of time: no limit of speed


@dataclasses.dataclass(frozen=True)
class AccelerationLimit(Effect):
    """|u'| <= 1 / slowness and |u''| <= 1 / inertness: u goes to the command c in the least time, and brakes for it.

    Exact for the command that is held over a sub-step, planned anew in each: it may speed up, cruise, brake and arrive
    within one. The actuator obeys the mean of u over the sub-step. A command nearer than u can stop is passed.

    Parameters: `slowness`, s per unit of the command, and `inertness`, s^2 per unit of the command; neutral 0.
    """

    name: ClassVar[str] = "acceleration_limit"
    kind: ClassVar[str] = "actuator"
    noun: ClassVar[str] = "motion profile of the drive"
    lacks: ClassVar[str] = "the drive's motion profile"
    separates: ClassVar[str] = "steps of several sizes, small ones among them"
    contains: ClassVar[tuple[str, ...]] = ("rate_limit",)
    witness = SET_POINT
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity("slowness", 0.0, 0.0, 2.0, unit="s/ctrl", per="1/command", reach=(0.0, 2.0), grid=(0.0, 0.05)),
        # a unit of the command takes 2 sqrt(inertness) s
        Quantity(
            "inertness", 0.0, 0.0, 0.5, unit="s^2/ctrl", per="1/command", reach=(0.0, 0.5),
            grid=(0.0005, 0.002, 0.01, 0.05, 0.2),
        ),
    )  # fmt: skip

    def init(self, at: Site) -> Any:
        return {"state": jnp.zeros(len(at)), "rate": jnp.zeros(len(at)), "fresh": jnp.ones((), bool)}

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        own = command[:, at.ids]
        h = jnp.float32(at.timestep)
        slowness, inertness = at.values(theta)[:, 0] / h, at.values(theta)[:, 1] / h**2

        def advance(state: tuple, c: jax.Array) -> tuple[tuple, jax.Array]:
            u, rate = state
            left, rate, mean = trapezoid(c - u, rate, slowness, inertness)
            return (c - left, rate), c - mean

        start = jnp.where(memory["fresh"], own[0], memory["state"])
        (state, rate), means = jax.lax.scan(advance, (start, jnp.where(memory["fresh"], 0.0, memory["rate"])), own)
        kept = {"state": state, "rate": rate, "fresh": jnp.zeros((), bool)}
        return kept, command.at[:, at.ids].set(means)


def trapezoid(
    way: jax.Array, rate: jax.Array, slowness: jax.Array, inertness: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Take the quickest motion to a target that ends there at rest, over one unit of time; exact for a held target.

    With w the way to the target, v the speed and b the inertness (1 / acceleration), a stop at once takes v |v| b / 2.
    Where w is not less, the motion speeds up along the way to a peak, cruises and brakes; else the same the other way
    round. The peak p closes the way, (p^2 - v^2) b / 2 + p^2 b / 2 = w, unless the limit of speed is lower: then the
    cruise closes it. It gives (way left at the end, rate there, mean of the way left).

    Without inertness the rate jumps; without slowness too the way is gone at once.
    """
    limited = inertness > 0
    b = jnp.where(limited, jnp.maximum(inertness, SOFT), 0.0)
    # towards the side on which a stop at once would not reach the target
    side = jnp.where(way >= 0.5 * b * rate * jnp.abs(rate), 1.0, -1.0)
    way, rate = side * way, side * rate
    # (b p)^2; while braking the other way round a difference of equals, which XLA may round in two ways in one call, so
    # that no branch may hang on its sign; its root has a derivative at rest too
    room = jnp.maximum(b * (way + 0.5 * b * rate**2), SHORT**2)
    free = (jnp.sqrt(room) - SHORT) / jnp.maximum(b, SOFT)
    top = 1.0 / jnp.maximum(slowness, STILL)
    capped = ~limited | (free > top)
    peak = jnp.where(capped, top, free)

    # what each phase takes, and how much of it there is time for; a speed above the limit is brought down to it first
    first, last = b * jnp.abs(peak - rate), b * peak
    even = jnp.where(capped, jnp.maximum(way - 0.5 * first * (rate + peak) - 0.5 * last * peak, 0.0), 0.0)
    cruise = slowness * even
    t1 = jnp.minimum(first, 1.0)
    t2 = jnp.minimum(cruise, 1.0 - t1)
    t3 = jnp.minimum(last, 1.0 - t1 - t2)
    fast = rate + _share(t1, first) * (peak - rate)
    slow = fast - _share(t3, last) * peak
    after = _share(t2, cruise) * even

    # in shares of a phase, not by 1 / b: derivatives stay small where b is
    left1 = way - 0.5 * t1 * (rate + fast)
    left2 = left1 - after
    left3 = left2 - 0.5 * t3 * (fast + slow)
    mean = way * t1 - t1**2 * (2.0 * rate + fast) / 6.0
    mean += (left1 - 0.5 * after) * t2
    mean += left2 * t3 - t3**2 * (2.0 * fast + slow) / 6.0
    arrived = first + cruise + last <= 1.0
    return jnp.where(arrived, 0.0, side * left3), jnp.where(arrived, 0.0, side * slow), side * mean


def _share(time: jax.Array, span: jax.Array) -> jax.Array:
    """Of a phase, in its time."""
    return jnp.where(span > time, time / jnp.maximum(span, SHORT), 1.0)
