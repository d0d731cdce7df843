"""Which effects the efforts call for, one by one while held-out parts of the data gain; and what they contradict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import DRIVES
from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term
from bayessim_mjx.diagnosis.equation_error.sums import Sums
from bayessim_mjx.diagnosis.logcheck.drive_channel import Channel
from bayessim_mjx.quantities import percent

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Criteria:
    """When an effect is proposed. Error rates: benchmarks/records/first_look.json.

    Attributes:
        nats: held-out log density that an effect has to bring, beside the logarithm of the number of effects tried.
        least: share of a joint's effort (rms) that an effect has to be; above: and of what stays unexplained there.
        looked: effects that are held out in each round, the best of all in sample.
        most: effects proposed at most; at several joints an effect is one.
        same: nats by which another effect may be behind to be told as well, and its share of the effect's own gain.
        tied: nats that one value everywhere loses against values at some places, so that it is contradicted.
        apart: by which the scales of two drives differ that have not one gain.
    """

    nats: float = 10.0
    least: float = 0.03
    above: float = 0.5
    looked: int = 8
    most: int = 4
    same: float = 5.0
    share: float = 0.1
    tied: float = 20.0
    apart: float = 0.05


CRITERIA = Criteria()
ALONE = ("payload",)  # effects of bodies: a robot carries one load
GAIN = "actuator_gain"
# frictions are not among them: 1 of 16 that were the same everywhere would have been lost
TIED = (GAIN,)
# what would make a drive's effort another function of its command than a scale and a constant
OF_DRIVES = ("actuator_deadband", "actuator_saturation", "rate_limit", "speed_torque_limit", "effort_loss")


Move = tuple[Term, ...]  # what is added in one step: a term, or one effect at all of its places


@dataclass(frozen=True, eq=False)
class Proposal:
    """An effect that the efforts call for.

    Attributes:
        term: the effect at its place; parameters, deviations: of the fit with all proposals.
        nats: held-out log density that it brought; rivals: labels of what would do as well in its place.
    """

    term: Term
    parameters: dict[str, float]
    deviations: dict[str, float]
    nats: float
    rivals: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        return self.term.label


@dataclass(frozen=True, eq=False)
class Found:
    """What the search came to: the known parameters alone, and with the proposals."""

    base: Fit
    fit: Fit
    proposals: tuple[Proposal, ...]
    density: tuple[float, float]  # held-out, of both


def search(sums: Sums, known: Sequence[Term], terms: Sequence[Term]) -> Found:
    """Forward selection with a look back; what is scaled or added twice is not tried.

    A step adds one term, or one effect at every joint with a number of its own at each, as real robots have friction
    in all of them; each further term has to bring the threshold. Where a gain is found, what drives have that models
    leave out (`DRIVES`) is tried in its place at all joints at once, and goes before it where it does as well.
    """
    found = _forward(sums, known, terms, ())
    if not any(p.term.effect == GAIN for p in found.proposals):
        return found
    others = [t for t in terms if t.effect != GAIN]
    if not (start := _drives(sums, known, others)):
        return found
    again = _forward(sums, known, others, start)
    return again if again.density[1] > found.density[1] - CRITERIA.same else found


def _drives(sums: Sums, known: Sequence[Term], terms: Sequence[Term]) -> tuple[Term, ...]:
    """Friction and rotor inertia of every joint, as far as they come out above nothing together."""
    own = [t for t in terms if t.effect in DRIVES and t.where != "all"]
    while own:
        now = fitting.fit(sums, [*known, *own])
        if now.feasible:
            break
        lowest = min(own, key=lambda t: float(np.min((now.of(t) - t.low) / now.deviation(t))))
        own.remove(lowest)
    return tuple(own)


def _forward(sums: Sums, known: Sequence[Term], terms: Sequence[Term], start: Sequence[Term]) -> Found:
    """The selection, from a set of effects on; those of it that do not bring the threshold go first."""
    base = fitting.fit(sums, known)
    threshold = CRITERIA.nats + math.log(max(len(terms), 1))
    chosen: list[tuple[Term, tuple[str, ...]]] = [(t, ()) for t in start]
    before = fitting.score(sums, known)
    density = fitting.score(sums, [*known, *start]) if start else before
    while len(fewer := _back(sums, known, chosen, density, threshold, spared=0)) < len(chosen):
        chosen, density = fewer, fitting.score(sums, [*known, *(t for t, _ in fewer)])
    now = fitting.fit(sums, [*known, *(t for t, _ in chosen)]) if chosen else base
    given = {t.effect for t in start}  # what drives have counts as one
    while len({t.effect for t, _ in chosen} - given) + bool(given) < CRITERIA.most:
        own = [t for t, _ in chosen]
        tried = _tried(sums, [*known, *own], _moves(terms, own), now, threshold)
        if not tried:
            break
        (best, score), *others = tried
        gain = float(score.sum() - density.sum())
        each = score - density
        if gain < threshold * len(best) or (len(each) > 1 and gain <= each.max()):  # or by one part of the data alone
            break
        after = fitting.fit(sums, [*known, *own, *best])
        if not any(_matters(sums, after, t) for t in best):
            break
        near = max(CRITERIA.same, CRITERIA.share * gain)
        same = tuple(m[0].label for m, s in others if len(m) == 1 and score.sum() - s.sum() < near)
        chosen += [(t, same if len(best) == 1 else ()) for t in best]
        now, density = after, score
        while len(fewer := _back(sums, known, chosen, density, threshold)) < len(chosen):
            chosen, density = fewer, fitting.score(sums, [*known, *(t for t, _ in fewer)])
    own = [t for t, _ in chosen]
    now = fitting.fit(sums, [*known, *own])
    density = fitting.score(sums, [*known, *own])
    return Found(base, now, _proposals(sums, known, chosen, now, density), (before.sum(), density.sum()))


def _moves(terms: Sequence[Term], own: Sequence[Term]) -> list[Move]:
    """What may be added to the terms chosen."""
    left = [t for t in terms if _apart(t, own)]
    each = {t.effect: tuple(o for o in left if o.effect == t.effect and o.where != "all") for t in left}
    return [*((t,) for t in left), *(m for e, m in each.items() if len(m) > 1 and e not in ALONE)]


def _tried(
    sums: Sums, kept: Sequence[Term], moves: Sequence[Move], now: Fit, threshold: float
) -> list[tuple[Move, Array]]:
    """Moves with their held-out densities, best first, of those that are best in sample."""
    fits = [(m, fitting.fit(sums, [*kept, *m], start=now.variance)) for m in moves]
    good = sorted(
        ((m, fitting.evidence(sums, f)) for m, f in fits if f.feasible and np.isfinite(f.values).all()),
        key=lambda p: -p[1],
    )
    held = [(m, fitting.score(sums, [*kept, *m], start=now.variance)) for m, _ in good[: CRITERIA.looked]]
    return sorted(held, key=lambda p: -(p[1].sum() - 0.5 * sum(t.count for t in p[0]) - threshold * (len(p[0]) - 1)))


def _matters(sums: Sums, after: Fit, term: Term) -> bool:
    """Whether an effect is worth telling, and more than noise of the motion makes of the known parameters."""
    left = np.sqrt(after.variance) / np.maximum(sums.size, 1e-300)
    limit = np.maximum(CRITERIA.least, CRITERIA.above * left)
    return bool(np.any(fitting.contribution(sums, after, term) > limit))


def _apart(term: Term, chosen: Sequence[Term]) -> bool:
    """Not the same effect twice at one place, at one and at all, nor two loads on one body."""
    same = [t for t in chosen if t.effect == term.effect]
    return all(t.where != term.where and "all" not in (t.where, term.where) for t in same)


def _back(
    sums: Sums,
    known: Sequence[Term],
    chosen: list[tuple[Term, tuple[str, ...]]],
    density: Array,
    threshold: float,
    spared: int = 1,
) -> list[tuple[Term, tuple[str, ...]]]:
    """Without what a later effect made superfluous; spared: so many of the last stay."""
    for pair in chosen[: len(chosen) - spared]:
        rest = [t for t, _ in chosen if t is not pair[0]]
        if density.sum() - fitting.score(sums, [*known, *rest]).sum() < threshold:
            return [p for p in chosen if p is not pair]
    return chosen


def _proposals(
    sums: Sums, known: Sequence[Term], chosen: Sequence[tuple[Term, tuple[str, ...]]], now: Fit, density: Array
) -> tuple[Proposal, ...]:
    out = []
    for term, same in chosen:
        rest = [t for t, _ in chosen if t is not term]
        gain = float(density.sum() - fitting.score(sums, [*known, *rest]).sum())
        values, own = now.of(term), now.at(term)
        means = dict(term.read(values))
        out.append(Proposal(term, means, _deviations(term, values, now.covariance[own, own]), gain, same))
    return tuple(sorted(out, key=lambda p: -p.nats))


def _deviations(term: Term, values: Array, covariance: Array) -> dict[str, float]:
    """Standard deviations of what is read from coefficients, by finite differences."""
    mean = term.read(values)
    steps = 1e-4 * np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    slopes = {k: np.zeros(len(values)) for k in mean}
    for i, step in enumerate(steps):
        moved = values.copy()
        moved[i] += step
        for k, x in term.read(moved).items():
            slopes[k][i] = (x - mean[k]) / step
    return {k: max(float(s @ covariance @ s), 0.0) ** 0.5 for k, s in slopes.items()}


def contradicted(
    sums: Sums, known: Sequence[Term], offered: Sequence[Term], found: Found, channels: Sequence[Channel]
) -> dict[str, str]:
    """{label of a candidate: why}."""
    out = {f"{effect}@all": why for effect in TIED if (why := _elsewhere(sums, known, offered, found, effect))}
    if why := _unlike(channels):
        out["actuator_gain@all"] = why
    sound = {c.actuator: c for c in channels if c.static and c.sound}
    for effect in OF_DRIVES:
        for name, c in sound.items():
            out[f"{effect}@{name}"] = f"{name}'s effort follows its command but for {percent(c.left)}"
        if sound:
            out[f"{effect}@all"] = f"{next(iter(sound))}'s effort follows its command"
    return out


def _elsewhere(sums: Sums, known: Sequence[Term], offered: Sequence[Term], found: Found, effect: str) -> str:
    """Why an effect is not the same everywhere: at some places alone it explains far more; or nothing."""
    own = [p for p in found.proposals if p.term.effect == effect and p.term.where != "all"]
    tied = [t for t in offered if (t.effect, t.where) == (effect, "all")]
    if not own or not tied:
        return ""
    others = [p.term for p in found.proposals if p not in own]
    density = float(fitting.score(sums, [*known, *others, *tied]).sum())
    if found.density[1] - density < CRITERIA.tied:
        return ""
    values = [f"{next(iter(p.parameters.values())):.2g} at {p.term.where}" for p in own]
    return f"{' and '.join(values)}, and not elsewhere"


def _unlike(channels: Sequence[Channel]) -> str:
    """Two drives whose efforts are different shares of what was commanded; or nothing."""
    known = sorted((c for c in channels if c.identified and not c.echo), key=lambda c: c.scale)
    if len(known) < 2 or all(c.off == 1.0 for c in known):
        return ""
    low, high = known[0], known[-1]
    if high.scale - low.scale < CRITERIA.apart + 3.0 * (low.deviation + high.deviation):
        return ""
    return f"{low.scale:.2g} of the command at {low.actuator}, {high.scale:.2g} at {high.actuator}"
