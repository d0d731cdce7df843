"""Which effects the efforts call for, step by step while the evidence grows; and what they contradict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.data_sheet import DRIVES
from bayessim_mjx.diagnosis.equation_error import fit as fitting
from bayessim_mjx.diagnosis.equation_error import terms
from bayessim_mjx.diagnosis.equation_error.fit import Fit, Term
from bayessim_mjx.diagnosis.equation_error.sums import Sums, gather
from bayessim_mjx.diagnosis.logcheck import drives
from bayessim_mjx.diagnosis.logcheck.drives import LEAST
from bayessim_mjx.diagnosis.logcheck.effort import HALF
from bayessim_mjx.diagnosis.logcheck.links import Channel
from bayessim_mjx.diagnosis.logcheck.timing import SURE
from bayessim_mjx.diagnosis.selection.numbers import EFFORT, ODDS
from bayessim_mjx.effects.support.actuators import OfGains, OfLoops
from bayessim_mjx.logs.log import Log
from bayessim_mjx.physics import controllers
from bayessim_mjx.quantities import percent

Array = NDArray[np.float64]
STRONG = math.log(ODDS.strong)  # nats
ALONE = ("payload",)  # effects of bodies: a robot carries one load
GAIN = "actuator_gain"
# what would make a drive's effort another function of its command than a scale and a constant
OF_DRIVES = ("actuator_deadband", "actuator_saturation", "rate_limit", "speed_torque_limit", "effort_loss")

Move = tuple[Term, ...]  # what is added in one step: a term, or one effect at all of its places


@dataclass(frozen=True, eq=False)
class Proposal:
    """An effect that the efforts call for.

    Attributes:
        term: the effect at its place; parameters, deviations: of the fit with all proposals.
        nats: log evidence that it brings; rivals: labels of what would do as well in its place.
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
    """What the search came to: the known parameters alone, and with the proposals; evidence: nats of the latter."""

    base: Fit
    fit: Fit
    proposals: tuple[Proposal, ...]
    evidence: float


@dataclass(frozen=True, eq=False)
class _Search:
    """Sets of effects beside the known parameters, by evidence.

    An effect is priced by its prior odds, one of all that are offered, and by odds that are strong (`Odds`); each of
    its numbers by half the logarithm of the rows (Schwarz, Annals of Statistics 6, 1978, 461).
    """

    sums: Sums
    known: Sequence[Term]
    offered: Sequence[Term]

    def fit(self, terms: Sequence[Term]) -> Fit:
        return fitting.fit(self.sums, [*self.known, *terms])

    def evidence(self, terms: Sequence[Term], found: Fit | None = None) -> float:
        """Nats less prices; minus infinity where a coefficient is where it may not be."""
        found = found or self.fit(terms)
        if not (found.feasible and np.isfinite(found.values).all()):
            return -math.inf
        each = STRONG + math.log(max(len(self.offered), 1))
        rows = math.log(max(float(self.sums.rows.sum()), 1.0))
        return fitting.evidence(self.sums, found) - sum(each + 0.5 * rows * t.count for t in terms)

    def matters(self, found: Fit, terms: Sequence[Term]) -> bool:
        """Whether an effect is relevant at a joint."""
        return any(bool(np.any(fitting.contribution(self.sums, found, t) > LEAST)) for t in terms)

    def forward(self, start: Sequence[Term] = ()) -> tuple[list[Term], dict[str, tuple[str, ...]], float]:
        """(effects, {label: rivals}, evidence) from a set on: what adds most evidence, then without what adds none.

        A step adds one term, or one effect at every joint with a number of its own at each, as real robots have
        friction in all of them.
        """
        chosen, rivals = [*start], {}
        now = self.back(chosen)
        for _ in range(EFFORT.rounds):
            fits = [(m, self.fit([*chosen, *m])) for m in _moves(self.offered, chosen)]
            tried = [(m, f, self.evidence([*chosen, *m], f)) for m, f in fits]
            good = sorted(tried, key=lambda t: -t[2])
            best = next((m for m, f, e in good if e > now and self.matters(f, m)), None)
            if best is None:
                break
            top = next(e for m, _, e in good if m is best)
            if len(best) == 1:
                near = (m for m, _, e in good if len(m) == 1 and m is not best and abs(top - e) < STRONG)
                rivals[best[0].label] = tuple(t.label for (t,) in near)
            chosen += best
            now = self.back(chosen)
        return chosen, rivals, now

    def back(self, chosen: list[Term]) -> float:
        """Evidence, after what others make superfluous was taken out."""
        now = self.evidence(chosen)
        while chosen:
            fewer = [(self.evidence([t for t in chosen if t is not x]), x) for x in chosen]
            best, x = max(fewer, key=lambda p: p[0])
            if best < now:
                break
            chosen.remove(x)
            now = best
        return now


def search(sums: Sums, known: Sequence[Term], terms: Sequence[Term]) -> Found:
    """Forward selection with a look back; what is scaled or added twice is not tried.

    Where a gain is found, what drives have that models leave out (`DRIVES`) is tried in its place at all joints at
    once, and goes before it where it does as well.
    """
    own = _Search(sums, known, terms)
    chosen, rivals, evidence = own.forward()
    if any(t.effect == GAIN for t in chosen):
        others = _Search(sums, known, [t for t in terms if t.effect != GAIN])
        again = others.forward(_drives(others))
        if again[2] > evidence - STRONG:
            own, (chosen, rivals, evidence) = others, again
    now = own.fit(chosen)
    out = []
    for term in chosen:
        gain = evidence - own.evidence([t for t in chosen if t is not term])
        values, at = now.of(term), now.at(term)
        means = dict(term.read(values))
        deviations = _deviations(term, values, now.covariance[at, at])
        out.append(Proposal(term, means, deviations, gain, rivals.get(term.label, ())))
    return Found(own.fit(()), now, tuple(sorted(out, key=lambda p: -p.nats)), evidence)


def _drives(own: _Search) -> list[Term]:
    """Friction and rotor inertia of every joint, as far as they come out above nothing together."""
    out = [t for t in own.offered if t.effect in DRIVES and t.where != "all"]
    while out and not (now := own.fit(out)).feasible:
        out.remove(min(out, key=lambda t: float(np.min((now.of(t) - t.low) / now.deviation(t)))))
    return out


def _moves(terms: Sequence[Term], own: Sequence[Term]) -> list[Move]:
    """List terms that may be added to those chosen."""
    left = [t for t in terms if _apart(t, own)]
    each = {t.effect: tuple(o for o in left if o.effect == t.effect and o.where != "all") for t in left}
    return [*((t,) for t in left), *(m for e, m in each.items() if len(m) > 1 and e not in ALONE)]


def _apart(term: Term, chosen: Sequence[Term]) -> bool:
    """Not the same effect twice at one place, at one and at all, nor two loads on one body."""
    same = [t for t in chosen if t.effect == term.effect]
    return all(t.where != term.where and "all" not in (t.where, term.where) for t in same)


def _deviations(term: Term, values: Array, covariance: Array) -> dict[str, float]:
    """Return standard deviations of what is read from coefficients, by finite differences."""
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
    # of gains alone: of frictions 1 of 16 that were the same everywhere would have been lost
    why = _unlike(channels) or _elsewhere(_Search(sums, known, offered), found)
    out = {f"{GAIN}@all": why} if why else {}
    sound = {c.actuator: c for c in channels if c.static and c.sound}
    for effect in OF_DRIVES:
        for name, c in sound.items():
            out[f"{effect}@{name}"] = f"{name}'s effort follows its command but for {percent(c.left)}"
        if sound:
            out[f"{effect}@all"] = f"{next(iter(sound))}'s effort follows its command"
    return out


def _elsewhere(search: _Search, found: Found) -> str:
    """Why gains are not the same everywhere: at some places alone they explain far more; or nothing."""
    own = [p for p in found.proposals if p.term.effect == GAIN and p.term.where != "all"]
    tied = [t for t in search.offered if t.label == f"{GAIN}@all"]
    others = [p.term for p in found.proposals if p not in own]
    if not own or not tied or found.evidence - search.evidence([*others, *tied]) < STRONG:
        return ""
    values = [f"{next(iter(p.parameters.values())):.2g} at {p.term.where}" for p in own]
    return f"{' and '.join(values)}, and not elsewhere"


def _unlike(channels: Sequence[Channel]) -> str:
    """Two drives whose efforts are different shares of what was commanded; or nothing."""
    known = sorted((c for c in channels if c.identified and not c.echo), key=lambda c: c.scale)
    if len(known) < 2 or all(c.off == 1.0 for c in known):
        return ""
    low, high = known[0], known[-1]
    if high.scale - low.scale < 2 * LEAST + SURE * (low.deviation + high.deviation):
        return ""
    return f"{low.scale:.2g} of the command at {low.actuator}, {high.scale:.2g} at {high.actuator}"


def described(sums: Sums, known: Sequence[Term], offered: Sequence[Term], stated: bool) -> tuple[Found, float]:
    """Describe the search's result and the unit of the efforts: free where none is stated, unless it is 1."""
    measured = np.array(sums.source) == "effort"
    if stated or not measured.any():
        return search(sums, known, offered), 1.0
    unit = terms.scale("effort_unit", "all", measured)
    others = [t for t in offered if (t.effect, t.where) != ("actuator_gain", "all")]
    found = search(sums, [*known, unit], others)
    factor = 1.0 / float(found.fit.of(unit)[0])
    if abs(np.log(abs(factor) + 1e-12)) < terms.SURE:
        return search(sums, known, offered), 1.0
    return found, factor


# Gains of servos and controllers, checked against the model itself: a fast loop moves between the rows of a log


class OfModel:
    """Sums of the model's own logs of the same commands, made when they are first needed."""

    def __init__(self, logs: Sequence[Log], model: mujoco.MjModel) -> None:
        self.logs, self.model = logs, model

    @cached_property
    def sums(self) -> Sums:
        return gather([of_model(log, self.model) for log in self.logs], self.model)

    def artefacts(self, known: Sequence[Term], found: Found) -> set[str]:
        """Return labels of the proposed gains of which the model's own logs show a half or more."""
        gains = [p.term for p in found.proposals if of_loop(p.term)]
        there = fitting.fit(self.sums, [*known, *(p.term for p in found.proposals)]) if gains else found.fit
        return {t.label for t in gains if abs(there.of(t)[0]) > HALF * abs(found.fit.of(t)[0])}


def of_loop(term: Term) -> bool:
    """Whether a term is a gain of a servo or a declared controller."""
    return term.bent is not None and issubclass(library.load(term.effect), OfGains | OfLoops)


def of_model(log: Log, model: mujoco.MjModel) -> Log:
    """Return the log that the model makes of the same commands, without noise, from the same start."""
    data = mujoco.MjData(model)
    law = drives.DeclaredLaw(controllers.read(log.metadata, model, log.actuators, log.name))
    data.qpos[:], data.qvel[:] = log.qpos[0], log.qvel[0]
    step, rows = float(model.opt.timestep), []
    for k, time in enumerate(log.time):
        while k and data.time < time - log.time[0] - step / 2:
            data.ctrl[:] = law(log.ctrl[k - 1], data.qpos, data.qvel)
            mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel]))
    qpos, qvel = np.split(np.nan_to_num(np.array(rows)), [model.nq], axis=1)
    # a measured effort did not make this motion
    streams = {name: own for name, own in log.streams.items() if not name.startswith("effort:")}
    return replace(log, qpos=qpos, qvel=qvel, streams=streams)
