"""Equations of motion of a tree of links, in float64, and classical Runge-Kutta steps of them: no part is MuJoCo's.

The robot's constants are those of the compiled model. Positions, Jacobians, mass matrix, velocity products, springs,
damping, actuators and stops are written down anew: Newton-Euler equations of each body, projected on the joints
(Featherstone, Rigid Body Dynamics Algorithms, 2008, chapters 2 and 6), all in world axes.

A stop of a joint (the flanks of a backlash) is a spring and a damper that push and never pull.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from own_robot import Robot, across

# Classical Runge-Kutta: where each stage stands and what it weighs, of a step
STAGES = np.array([[0, 1 / 6], [1 / 2, 1 / 3], [1 / 2, 1 / 3], [1, 1 / 6]])


# Sums of products in place of matrix products: XLA makes one loop of several, and calls no library for 3 by 3.
def _product(a: Any, b: Any) -> Any:
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def _applied(a: Any, x: Any) -> Any:
    return (a * x[..., None, :]).sum(-1)


def _cross(a: Any, b: Any) -> Any:
    x, y, z = (a[..., i] * b[..., j] - a[..., j] * b[..., i] for i, j in ((1, 2), (2, 0), (0, 1)))
    return jnp.stack([x, y, z], -1)


def frames(bot: Robot, q: Any) -> tuple[Any, Any]:
    """(axes [n, 3, 3], origins [n, 3]) of the joints' frames in the world at positions q [n]."""
    crossed = np.array([across(a) for a in bot.axis])
    moved = q - bot.zero
    angle, slid = moved * bot.hinge, moved * (1 - bot.hinge)
    # Rodrigues' formula
    own = (
        np.eye(3) + jnp.sin(angle)[:, None, None] * crossed + (1 - jnp.cos(angle))[:, None, None] * (crossed @ crossed)
    )
    turned = _product(bot.turn, own)
    at = bot.way + _applied(bot.turn, bot.axis * slid[:, None])
    axes: list[Any] = []
    origins: list[Any] = []
    for i, k in enumerate(bot.parent):
        axes.append(turned[i] if k < 0 else _product(axes[k], turned[i]))
        origins.append(at[i] if k < 0 else origins[k] + _applied(axes[k], at[i]))
    return jnp.stack(axes), jnp.stack(origins)


def equations(bot: Robot, q: Any, v: Any) -> tuple[Any, Any, Any, Any]:
    """At positions q and velocities v [n]: what forces at the joints and on the bodies are equal to.

    Returns:
        Mass matrix [n, n]; bias [n], of gravity and velocities; Jacobians [nb, n, 3] of the bodies' centres of mass and
        of their turning. Mass matrix times accelerations plus bias are the forces.
    """
    axes, origins = frames(bot, q)
    hinge, turns = bot.hinge[:, None], bot.hinge[:, None] > 0
    axis, body = _applied(axes, bot.axis), axes[bot.link]
    centre = origins[bot.link] + _applied(body, bot.centre)

    def moving(points: Any, by: np.ndarray) -> Any:
        """[points, n, 3] m of each point by unit of each joint."""
        arm = points[:, None] - origins
        return jnp.where(turns, _cross(axis, arm), axis) * by[:, :, None]

    def drifting(points: Any, shifts: Any, by: np.ndarray) -> Any:
        """`moving`, by time; shifts: [points, 3] m/s."""
        arm, drift = points[:, None] - origins, shifts[:, None] - origin_speed
        return jnp.where(turns, _cross(swing, arm) + _cross(axis, drift), swing) * by[:, :, None]

    speeds = v[:, None]
    origin_speed = (moving(origins, bot.before) * speeds).sum(1)
    swing = _cross(((axis * hinge) * (bot.before * v)[:, :, None]).sum(1), axis)  # of the axes, by time
    linear, angular = moving(centre, bot.moves), (axis * hinge) * bot.moves[:, :, None]
    gained = (drifting(centre, (linear * speeds).sum(1), bot.moves) * speeds).sum(1) - bot.gravity
    rate, spun = (angular * speeds).sum(1), ((swing * hinge) * (bot.moves * v)[:, :, None]).sum(1)
    inertia = _product(_product(body, bot.inertia), jnp.swapaxes(body, 1, 2))
    force = bot.mass[:, None] * gained
    torque = _applied(inertia, spun) + _cross(rate, _applied(inertia, rate))
    bias = (linear * force[:, None]).sum((0, 2)) + (angular * torque[:, None]).sum((0, 2))
    heavy = bot.mass[:, None, None] * (linear[:, :, None] * linear[:, None]).sum(-1)
    bulky = (angular[:, :, None] * _applied(inertia[:, None], angular)[:, None]).sum(-1)
    return (heavy + bulky).sum(0) + np.diag(bot.rotor), bias, linear, angular


def passive(bot: Robot, q: Any, v: Any) -> Any:
    """[n] forces of springs, dampers and stops."""
    x, speed = q - bot.rest, jnp.abs(v)
    spring = -x * (bot.spring[:, 0] + bot.spring[:, 1] * x + bot.spring[:, 2] * x * x)
    damper = -v * (bot.damping[:, 0] + bot.damping[:, 1] * speed + bot.damping[:, 2] * speed * speed)
    if not np.isfinite(bot.high).any():
        return spring + damper
    above, below = q - bot.high, bot.low - q
    pushed_down = jnp.where(above > 0, jnp.maximum(bot.stop * above + bot.wear * v, 0.0), 0.0)
    pushed_up = jnp.where(below > 0, jnp.maximum(bot.stop * below - bot.wear * v, 0.0), 0.0)
    return spring + damper + pushed_up - pushed_down


@dataclasses.dataclass(frozen=True)
class Given:
    """What is held over some steps: ctrl, gain, low, high [nu], bias [nu, 3], force [n], push [nb, 6] (force, torque).

    bias: of an actuator's force by 1, by its length and by its speed; low, high: ends of its force.
    """

    ctrl: Any
    gain: Any
    bias: Any
    low: Any
    high: Any
    force: Any
    push: Any

    @classmethod
    def split(cls, bot: Robot, flat: Any) -> "Given":
        nu, n, nb = len(bot.lag), len(bot.zero), len(bot.mass)
        ends = np.cumsum([nu, nu, 3 * nu, nu, nu, n])
        ctrl, gain, bias, low, high, force, push = jnp.split(flat, ends)
        return cls(ctrl, gain, bias.reshape(nu, 3), low, high, force, push.reshape(nb, 6))


def driven(bot: Robot, q: Any, v: Any, act: Any, given: Given) -> tuple[Any, Any]:
    """(forces of actuators, rate of what their filters hold), [nu]."""
    command = jnp.clip(given.ctrl, bot.limit[:, 0], bot.limit[:, 1])
    acting = jnp.where(bot.lag > 0, act, command)
    length, speed = (bot.gear * q).sum(1), (bot.gear * v).sum(1)
    force = given.gain * acting + given.bias[:, 0] + given.bias[:, 1] * length + given.bias[:, 2] * speed
    force = jnp.where(bot.forced > 0, jnp.clip(force, given.low, given.high), force)
    return force, jnp.where(bot.lag > 0, (command - act) / np.where(bot.lag > 0, bot.lag, 1.0), 0.0)


def change(bot: Robot, q: Any, v: Any, act: Any, given: Given) -> tuple[Any, Any, Any]:
    """(accelerations [n], rate of filters [nu], (forces of actuators [nu], at the joints [n], bias [n]))."""
    mass, bias, linear, angular = equations(bot, q, v)
    effort, rate = driven(bot, q, v, act, given)
    drive = (bot.gear * effort[:, None]).sum(0)
    outside = (linear * given.push[:, None, :3] + angular * given.push[:, None, 3:]).sum((0, 2))
    force = drive + passive(bot, q, v) + given.force + outside - bias
    return jnp.linalg.solve(mass, force), rate, (effort, drive, bias)


@functools.cache
def _programs() -> dict[tuple[bytes, ...], Callable[..., Any]]:
    return {}


def program(bot: Robot) -> Callable[[np.ndarray, np.ndarray, float, int], np.ndarray]:
    """A compiled function of (state [2 n + nu]: positions, velocities, filters; `Given` flat; step in s; steps).

    It returns the state behind the steps, and beside it the forces at the beginning of the last one, flat.
    """
    return _programs().setdefault(bot.key(), jax.jit(functools.partial(_advanced, bot)))


def _advanced(bot: Robot, state: Any, flat: Any, step: Any, count: Any) -> Any:
    given, n, nu = Given.split(bot, flat), len(bot.zero), len(bot.lag)

    def stage(carry: Any, own: Any) -> tuple[Any, Any]:
        start, slope, total = carry
        at = start + step * own[0] * slope
        speeds = at[n : 2 * n]
        gained, rate, forces = change(bot, at[:n], speeds, at[2 * n :], given)
        slope = jnp.concatenate([speeds, gained, rate])
        return (start, slope, total + own[1] * slope), jnp.concatenate(forces)

    def one(_: Any, carry: Any) -> Any:
        start = carry[0]
        still = jnp.zeros_like(start)
        (_, _, mean), forces = jax.lax.scan(stage, (start, still, still), STAGES)
        return start + step * mean, forces[0]

    return jnp.concatenate(jax.lax.fori_loop(0, count, one, (state, jnp.zeros(nu + 2 * n))))
