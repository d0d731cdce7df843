"""Relations between laws: which may be in one model, which may replace another, and which one hides.

**Replacement.** A payload, a centre of mass that is off and a link's mass change the same ten numbers of a body. A fit
from elsewhere comes to rest far from them: a payload's place hardly moves anything as long as its mass is wrong.

**Hidden** (`by_effects`). A bias beside a spring moves the spring's angle of rest; viscous friction beside friction by
direction is part of it. Such logs do not tell whether both are there: the named law stands for both.

**Stand-ins** (`stand_ins`, `by_parameters`). A joint's viscous friction is its damping, rotor inertia beside a slide is
its mass, a drive's gain is all of the robot's inertia, damping and friction together. The prior decides whether the
data sheet is wrong or an effect is missing.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from bayessim_mjx.diagnosis.evidence.parameters import unlikely
from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.logcheck.rigid_body import inertial
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, HIDDEN, ODDS, Progress
from bayessim_mjx.diagnosis.selection.screen import Column, Projection, Screened, judged, looked_at, part, simulated
from bayessim_mjx.diagnosis.selection.search_state import SearchState
from bayessim_mjx.effects import load, names
from bayessim_mjx.parameters import geometry
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]
AMOUNTS = np.linspace(0.0, 1.0, 101)[1:]  # of an effect, shares of the largest in its range
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
    late = one.effect != other.effect and _said(one.effect, "late") and _said(other.effect, "late")
    return bool(late) and _joint(one, model) == _joint(other, model)


def _joint(c: Candidate, model: mujoco.MjModel) -> str:
    """Return the joint of a candidate; of an actuator the joint that it drives."""
    if c.kind != "actuator" or c.where not in [model.actuator(i).name for i in range(model.nu)]:
        return c.where
    driven = model.actuator(c.where)
    on_joint = int(driven.trntype[0]) == mujoco.mjtTrn.mjTRN_JOINT
    return str(model.joint(int(driven.trnid[0])).name) if on_joint else c.where


def inertia(one: Candidate, other: Candidate) -> bool:
    """Whether both change the inertia of the same body."""
    here = one.kind == other.kind == "body" and one.where == other.where and one.effect != other.effect
    return here and bool(_said(one.effect, "inertial") and _said(other.effect, "inertial"))


def special_cases(effect: Candidate) -> tuple[str, ...]:
    """Names of the effects that are special cases of it, from its class."""
    return tuple(_said(effect.effect, "contains"))


@functools.cache  # thousands of pairs are compared, and all installed packages are looked through for a name
def _said(effect: str, attribute: str) -> Any:
    """Return the class of an effect."""
    return getattr(load(effect), attribute, ()) if effect in names() else ()


def neutral_beyond(case: Candidate, law: Candidate, values: Array) -> bool:
    """Whether a law with these numbers is its special case: what acts in it beyond the case's numbers is neutral."""
    own = {c.name.rsplit(".", 1)[1] for c in case.coordinates}
    pairs = list(zip(law.coordinates, law.shapes, values, strict=True))
    more = [(c, v) for c, shape, v in pairs if not shape and c.name.rsplit(".", 1)[1] not in own]
    return len(more) < len(pairs) - sum(law.shapes) and all(v == c.neutral for c, v in more)


def as_large(one: Candidate, other: Candidate, values: Array) -> tuple[Array, ...]:
    """Return a law's numbers at another's values of the same units, in their order; neutral where there are none.

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
    """Return the law's numbers, and known parameters, at which bodies have the inertia of a fitted model, or nearly so.

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


def by_effects(state: SearchState, answer: Model, say: Progress = lambda text, done, total: None) -> tuple[str, ...]:
    """List the labels of candidates that the answer's effects hide, and that show without these effects."""
    if not answer.effects:
        return ()
    others = [c for c in state.candidates if all(compatible(c, e) for e in answer.effects)]
    alone, likely = _shown(state, state.base, others), _shown(state, answer, others)
    shown = 1.0 - (1.0 - HIDDEN) ** 0.5  # halfway, on a log scale, between what is hidden and what shows wholly
    some = [label for label in likely if alone[label][0][0].absorbed < shown < likely[label][0][0].absorbed]
    some = sorted(some, key=lambda label: -likely[label][0][0].absorbed)[: EFFORT.batch]
    plans = [(s.candidate, point) for label in some for s, point in likely[label][: EFFORT.points]]
    own = looked_at(answer.fit, state.settings.screened)
    columns = simulated(
        state.fitter,
        answer.fit,
        plans,
        own,
        lambda _, done, all_: say("masked effects", done, all_),
    )
    found = judged(answer.fit, columns, own)
    return tuple(label for label, each in found.items() if min(s.absorbed for s, _ in each) > HIDDEN)


def _shown(
    state: SearchState, model: Model, candidates: Sequence[Candidate]
) -> dict[str, list[tuple[Screened, Array]]]:
    """{label: what is hidden of it at each starting point}, what shows most first, without a simulation."""
    found = judged(model.fit, state.secants.of(candidates), state.secants.own)
    return {label: sorted(several, key=lambda pair: pair[0].absorbed) for label, several in found.items()}


@dataclass(frozen=True, eq=False)
class StandIn:
    """An effect that may do the work of a known parameter's deviation from the data sheet.

    Attributes:
        nats: by which the known parameters are likelier; column: of the effect, at one of its points.
        point: `[k]`, its numbers in the best amount; steps: `[k]`, of the fit's numbers that this amount does.
    """

    nats: float
    column: Column
    point: Array
    steps: Array


def by_parameters(answer: Model, larger: Sequence[Model]) -> dict[str, tuple[str, ...]]:
    """List {known parameter: labels of effects with which it is nearer to the data sheet by half of its way and more}.

    Args:
        larger: the answer with further effects, that the evidence does not speak strongly against.
    """
    out: dict[str, tuple[str, ...]] = {}
    for model in larger:
        more = [e.label for e in model.effects if e not in answer.effects]
        away = dict(zip(model.fit.names, model.fit.away, strict=True))
        for c, alone in zip(answer.fit.coordinates, answer.fit.away, strict=True):
            if (c.stated or c.kind) and abs(away[c.name]) < 0.5 * abs(alone):
                out[c.name] = tuple(dict.fromkeys([*out.get(c.name, ()), *more]))
    return out


def stand_ins(state: SearchState, answer: Model) -> list[StandIn]:
    """Find effects that known parameters may stand for, without a simulation.

    Known parameters do all their work (`HIDDEN`). Without the effect's part the parameters are so much likelier that
    the odds against the effect, one of all candidates and in its best size, are below `ODDS.strong`, and by
    `ODDS.mention` at least. Beside the best one stand those that the data sheet does not speak strongly against; then
    the rest is looked at in the same way. Whether one stands beside the answer, the evidence of its fit decides.
    """
    columns = state.secants.of(c for c in state.candidates if all(compatible(c, e) for e in answer.effects))
    columns = [c for c in columns if c.way.any()]
    if not columns:
        return []
    fit = part(answer.fit, state.secants.own)
    project = Projection(fit)
    works = [(c, steps) for c in columns if (steps := project.taken(c.change, HIDDEN)) is not None]
    least = max(-state.log_prior(frozenset("x")) - np.log(ODDS.strong), np.log(ODDS.mention))
    away, out = fit.away, list[StandIn]()
    while works:
        gains: dict[str, StandIn] = {}
        for column, steps in works:
            gain, old = _gain(fit, away, column, steps), gains.get(column.candidate.label)
            gains[column.candidate.label] = gain if old is None or gain.nats > old.nats else old
        best = max(gains.values(), key=lambda gain: gain.nats)
        if best.nats <= least:
            break
        now = {label: g for label, g in gains.items() if g.nats > max(least, best.nats - np.log(ODDS.strong))}
        out += now.values()
        works = [(column, steps) for column, steps in works if column.candidate.label not in now]
        away = away - best.steps
    return out


def _gain(fit: Fit, away: Array, column: Column, steps: Array) -> StandIn:
    """In its best amount, of parameters so far from the data sheet `[k]`; steps: that do the work of the column."""
    amounts = np.array([end * AMOUNTS for end in column.room if np.isfinite(end)]).ravel()
    amounts = np.append(amounts, 0.0)  # none
    gains = [unlikely(fit.coordinates, away) - unlikely(fit.coordinates, away - t * steps) for t in amounts]
    amount = float(amounts[np.argmax(gains)])
    return StandIn(max(gains), column, column.at(amount), amount * steps)
