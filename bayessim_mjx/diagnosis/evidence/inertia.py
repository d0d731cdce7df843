"""Where a model begins that has another law of inertia in place of one of its own: with the same inertia.

A payload, a centre of mass that is off and a link's mass change the same ten numbers of a body. A fit from elsewhere
comes to rest far from them: a payload's place hardly moves anything as long as its mass is wrong.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.logcheck.rigid_body import inertial
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.parameters import geometry
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]
APART = 1e-3  # of a range: finite differences, of inertias in single precision
# standard deviations of the priors as a share of a body's inertia: they decide what its inertia leaves open
OPEN = 1e-2


@dataclass(frozen=True)
class Start:
    """Values `[base]` of the known parameters and `[k]` of a law's own numbers."""

    known: Array
    own: Array


def alike(fitter: Fitter, model: Model, effect: Candidate, law: Candidate) -> Start | None:
    """The law's numbers, and known parameters, that give the bodies most nearly the inertia of a fitted model.

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
    sure = OPEN * np.sqrt([c.precision for c in free])

    def off(x: Array) -> Array:
        theta = fitter.vector([*others, *free], np.concatenate([fit.values[kept], x]))
        return np.concatenate([((_inertia(physics, theta) - wanted) / scale).ravel(), sure * (x - neutral)])

    begun = np.concatenate([fit.values[moving], law.probes[len(law.probes) // 2]])
    found = least_squares(off, np.clip(begun, low, high), bounds=(low, high), x_scale=high - low, diff_step=APART)
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
