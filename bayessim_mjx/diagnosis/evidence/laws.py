"""Relations between laws: which may be in one model, which may replace another, and where a replacement begins.

A payload, a centre of mass that is off and a link's mass change the same ten numbers of a body. A fit from elsewhere
comes to rest far from them: a payload's place hardly moves anything as long as its mass is wrong.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.logcheck.rigid_body import inertial
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.effects import load, names
from bayessim_mjx.parameters import geometry
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]
SINGLE = float(np.finfo(np.float32).eps) ** 0.5  # of inertias in single precision: best step of a difference, of 1


def compatible(a: Candidate, b: Candidate) -> bool:
    """Whether two effects share no number; one at a joint shares its numbers with the same one tied over all joints."""
    return not {i for c in a.coordinates for i in c.index} & {i for c in b.coordinates for i in c.index}


def beside(a: Candidate, b: Candidate) -> bool:
    """Whether both may be in one model: they share no number, and none is a special case of the other."""
    within = a.where == b.where and (a.effect in special_cases(b) or b.effect in special_cases(a))
    return a.label != b.label and compatible(a, b) and not within


def special_case(one: Candidate, of: Candidate) -> bool:
    """Whether `one` is a special case of a law at its place, or of a law that is tied over all places."""
    at_one = of.where == "all" != one.where and one.kind == of.kind
    contained = one.effect in special_cases(of)
    return contained and (at_one or one.where == of.where) or at_one and one.effect == of.effect


def related(one: Candidate, other: Candidate) -> bool:
    """Whether `one` may replace the other: special case, law that contains it, or another inertia of the same body."""
    here = one.where == other.where and one.effect != other.effect
    return special_case(one, other) or (here and special_case(other, one)) or inertia(one, other)


def same_lateness(one: Candidate, other: Candidate, model: mujoco.MjModel) -> bool:
    """Whether both make a signal of the same joint late: a delay T and a lag T shift slow signals alike, by T."""
    late = one.effect != other.effect and _late(one.effect) and _late(other.effect)
    return late and _joint(one, model) == _joint(other, model)


def _joint(c: Candidate, model: mujoco.MjModel) -> str:
    """The joint of a candidate; of an actuator the joint that it drives."""
    if c.kind != "actuator" or c.where not in [model.actuator(i).name for i in range(model.nu)]:
        return c.where
    driven = model.actuator(c.where)
    on_joint = int(driven.trntype[0]) == mujoco.mjtTrn.mjTRN_JOINT
    return str(model.joint(int(driven.trnid[0])).name) if on_joint else c.where


def inertia(one: Candidate, other: Candidate) -> bool:
    """Whether both change the inertia of the same body."""
    here = one.kind == other.kind == "body" and one.where == other.where and one.effect != other.effect
    return here and _inertial(one.effect) and _inertial(other.effect)


def special_cases(effect: Candidate) -> tuple[str, ...]:
    """Names of the effects that are special cases of it, from its class."""
    return _contained(effect.effect)


@functools.cache  # thousands of pairs are compared, and all installed packages are looked through for a name
def _contained(effect: str) -> tuple[str, ...]:
    return tuple(getattr(load(effect), "contains", ())) if effect in names() else ()


@functools.cache
def _late(effect: str) -> bool:
    return effect in names() and bool(load(effect).late)


@functools.cache
def _inertial(effect: str) -> bool:
    return effect in names() and bool(load(effect).inertial)


def as_large(one: Candidate, other: Candidate, values: Array) -> tuple[Array, ...]:
    """A law's numbers at the values of another's with the same units, in their order; neutral where there are none.

    The last value serves further numbers of its unit. () if no unit is the same.
    """
    found = []
    there = {
        c.unit: [v for o, v in zip(other.coordinates, values.tolist(), strict=True) if o.unit == c.unit]
        for c in one.coordinates
    }
    for c in one.coordinates:
        same = there[c.unit]
        value = c.neutral if not same else same.pop(0) if len(same) > 1 else same[0]
        found.append(float(np.clip(value, c.low, c.high)))
    return (np.array(found),) if any(there.values()) else ()


@dataclass(frozen=True)
class Start:
    """Values `[base]` of the known parameters and `[k]` of a law's own numbers."""

    known: Array
    own: Array


def with_same_inertia(fitter: Fitter, model: Model, effect: Candidate, law: Candidate) -> Start | None:
    """The law's numbers, and known parameters, at which the bodies have the inertia of a fitted model, or nearly so.

    Args:
        effect: of the model, in whose place the law stands.

    Returns:
        None if the law has no starting point.
    """
    if not len(law.probes):
        return None
    base, fit = len(fitter.base), model.fit
    kept = [i for i, c in enumerate(fit.coordinates) if c not in effect.coordinates]
    others = [fit.coordinates[i] for i in kept]
    physics, nominal = fitter.simulator.physics, fitter.theta
    rest = _inertia(physics, nominal)
    scale = _scale(rest)
    wanted = _inertia(physics, fitter.vector(fit.coordinates, fit.values))
    moving = [i for i in range(base) if _moves(fitter, i, rest)]
    free = [fitter.base[i] for i in moving] + list(law.coordinates)
    low, high, neutral = (np.array([getattr(c, end) for c in free]) for end in ("low", "high", "neutral"))
    sure = SINGLE * np.sqrt([c.precision for c in free])

    def off(x: Array) -> Array:
        theta = fitter.vector([*others, *free], np.concatenate([fit.values[kept], x]))
        return np.concatenate([((_inertia(physics, theta) - wanted) / scale).ravel(), sure * (x - neutral)])

    begun = np.concatenate([fit.values[moving], law.probes[len(law.probes) // 2]])
    found = least_squares(off, np.clip(begun, low, high), bounds=(low, high), x_scale=high - low, diff_step=SINGLE)
    known = fit.values[:base].copy()
    known[moving] = found.x[: len(moving)]
    return Start(known, found.x[len(moving) :])


def _moves(fitter: Fitter, i: int, rest: Array) -> bool:
    """Whether a known parameter changes an inertia."""
    values = np.array([c.neutral for c in fitter.base])
    values[i] += fitter.base[i].step
    return bool(np.any(_inertia(fitter.simulator.physics, fitter.vector(fitter.base, values)) != rest))


def _scale(inertia: Array) -> Array:
    """`[bodies, 10]`: a body's mass m, m r and m r^2, r its radius of gyration; infinite where it has no mass."""
    mass, second = inertia[:, :1], np.sum(inertia[:, 4:7], 1, keepdims=True)
    radius = np.sqrt(np.divide(second, mass, where=mass > 0, out=np.zeros_like(mass)))
    every = mass * np.concatenate([radius**0, *[radius] * 3, *[radius**2] * 6], axis=1)
    return np.where(every > 0, every, np.inf)


def _inertia(physics: Physics, theta: Array) -> Array:
    """`[bodies, 10]`, as of `rigid.inertial`, about the nominal centre of mass."""
    each = (np.asarray(x, np.float64) for x in _parts(physics, jnp.asarray(theta, jnp.float32)))
    return np.array([inertial(*own) for own in zip(*each, strict=True)])


@functools.partial(jax.jit, static_argnums=0)
def _parts(physics: Physics, theta: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of the bodies: masses `[b]`, centres from the nominal ones `[b, 3]`, inertias about them `[b, 3, 3]`."""
    fields = physics.unseen(theta, None, None).fields
    mass, place, frame, moments = (
        fields.get(name, getattr(physics.model, name))
        for name in ("body_mass", "body_ipos", "body_iquat", "body_inertia")
    )
    turn = jax.vmap(geometry.rotation)(frame)
    return mass, place - physics.model.body_ipos, jnp.einsum("bij,bj,bkj->bik", turn, moments, turn)
